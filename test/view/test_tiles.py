"""The images beside the scene: their message, and their area in a real browser."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("viser")

from pages import needs_browser, pause, paused_page, scrub, tiles_of, until, wait_for_tracks
from waiting import wait_until

from humansim_ros import Scene, Simulation
from humansim_ros.view.panels.images import images_message

SCENE = """\
room: null
humans:
  anna: {body: adult_woman, motion: {file: walk, position: [0.2, 0.4]}}
cameras:
  wide: {position: [3, 2, 1.6], look_at: [0, 0, 1], size: [480, 160]}
  tall: {position: [2, -2, 1.6], look_at: [0, 0, 1], size: [200, 400]}
  square: {position: [-2, -2, 1.6], look_at: [0, 0, 1], size: [300, 300]}
"""


def test_a_message_has_each_image_with_its_own_shape() -> None:
    wide = np.full((20, 60, 3), (250, 10, 10), np.uint8)
    tall = np.full((50, 16, 3), (10, 10, 250), np.uint8)
    data = images_message({"a": {"rgb": wide}, "b": {"rgb": tall, "depth": tall}, "c": {}})
    first, size = np.frombuffer(data[:8], np.uint32)
    table = json.loads(data[8 : 8 + size])
    assert first == 0xFFFFFFFF  # no frame has this number
    assert [(entry["camera"], entry["channel"]) for entry in table] == [
        ("a", "rgb"),
        ("b", "rgb"),
        ("b", "depth"),
    ]
    at = 8 + int(size)
    for entry, image in zip(table, (wide, tall, tall), strict=True):
        found = cv2.imdecode(np.frombuffer(data[at : at + entry["bytes"]], np.uint8), cv2.IMREAD_COLOR)
        assert (entry["height"], entry["width"]) == image.shape[:2]
        assert found is not None and np.abs(found[..., ::-1].astype(int) - image).max() < 12  # JPEG
        at += entry["bytes"]
    assert at == len(data)


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, Any]]:
    pytest.importorskip("playwright")
    path: Path = tmp_path_factory.mktemp("tiles") / "lab.yaml"
    path.write_text(SCENE)
    with paused_page(path) as (page, app):
        page.wait_for_function("document.querySelectorAll('[data-humansim=tiles] figure').length === 3")
        wait_for_tracks(page)
        yield page, app


def boxes(page: Any) -> tuple[Any, Any, dict[str, Any]]:
    """Rectangles (left, top, right, bottom) of the scene, the area of the images, and the images."""
    found = page.evaluate(
        """() => {
            const box = (node) => {
                const { left, top, right, bottom } = node.getBoundingClientRect();
                return [left, top, right, bottom];
            };
            const area = document.querySelector("[data-humansim=tiles]");
            const tiles = [...area.querySelectorAll("figure")];
            return [box(document.querySelector("canvas")), box(area),
                Object.fromEntries(tiles.map((tile) => [tile.dataset.humansim, box(tile)]))];
        }"""
    )
    return found[0], found[1], found[2]


def overlap(left: Any, right: Any) -> float:
    across = min(left[2], right[2]) - max(left[0], right[0])
    down = min(left[3], right[3]) - max(left[1], right[1])
    return float(max(across, 0) * max(down, 0))


@needs_browser
@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.process
@pytest.mark.parametrize("size", [(1280, 800), (800, 1200), (1000, 557)])
def test_images_never_cover_the_scene_or_each_other(opened: tuple[Any, Any], size: tuple[int, int]) -> None:
    page, _ = opened
    page.set_viewport_size({"width": size[0], "height": size[1]})

    def is_apart() -> bool:
        scene, area, _tiles = boxes(page)
        large = (scene[2] - scene[0]) * (scene[3] - scene[1]) > 100_000
        return large and overlap(scene, area) == 0

    until(is_apart)
    _scene, area, tiles = boxes(page)
    for name, (left, top, right, bottom) in tiles.items():
        assert overlap((left, top, right, bottom), area) == pytest.approx((right - left) * (bottom - top))
        assert sum(overlap((left, top, right, bottom), other) for other in tiles.values()) == pytest.approx(
            (right - left) * (bottom - top)
        )
        width, height = {"wide rgb": (480, 160), "tall rgb": (200, 400), "square rgb": (300, 300)}[name]
        assert (right - left) / (bottom - top) == pytest.approx(width / height, rel=0.01)


@needs_browser
@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.process
def test_the_bar_and_a_click_on_a_name_change_sizes(opened: tuple[Any, Any]) -> None:
    page, app = opened
    page.set_viewport_size({"width": 1280, "height": 800})
    until(lambda: boxes(page)[1][3] == boxes(page)[0][3] > 600)
    scene, area, _tiles = boxes(page)
    bar = page.get_by_role("separator", name="Size of the images")
    wanted = area[2] + 100

    def is_moved() -> bool:
        return boxes(page)[1][2] == pytest.approx(wanted, abs=6)

    for _ in range(4):  # on a busy machine the bar moves while it is looked for
        start, way = bar.bounding_box()["x"] + 4, wanted - boxes(page)[1][2]
        page.mouse.move(start, 600)
        page.mouse.down()
        page.mouse.move(start + way, 600)
        page.mouse.up()
        if wait_until(is_moved, 15):
            break
    assert is_moved()
    until(lambda: boxes(page)[0][0] == pytest.approx(scene[0] + 100, abs=6))

    before: list[float] = []

    def is_steady() -> bool:  # the page moves the images for a moment after the bar
        previous, before[:] = before[:], boxes(page)[2]["square rgb"]
        return previous == before

    assert wait_until(is_steady, 15, lambda: page.wait_for_timeout(500))
    page.get_by_role("button", name="square", exact=True).click()
    until(lambda: boxes(page)[2]["square rgb"][2] - boxes(page)[2]["square rgb"][0] > before[2] - before[0])
    page.locator("[data-humansim='square rgb'] img").click(position={"x": 30, "y": 20})
    page.get_by_role("tab", name="Numbers").click()
    page.get_by_role("cell", name="square", exact=True).wait_for()
    left, _, right, _ = boxes(page)[2]["square rgb"]
    scale = 300 / (right - left)
    cell = page.inner_text("table").replace("\t", " ")
    assert any(
        f"({int(30 * scale) + i}, {int(20 * scale) + j})" in cell for i in (-1, 0, 1) for j in (-1, 0, 1)
    )
    page.get_by_role("button", name="square", exact=True).click()
    until(lambda: boxes(page)[2]["square rgb"] == before)

    bar.focus()
    for _ in range(12):
        page.keyboard.press("ArrowLeft")
    until(lambda: boxes(page)[0][0] == pytest.approx(8, abs=1))  # the scene has all but the bar
    for _ in range(8):
        page.keyboard.press("ArrowRight")
    until(lambda: boxes(page)[1][2] > 100)

    box = next(box for box in app._show._channels.values() if box.value)
    box.value = False
    until(lambda: boxes(page)[0][0] == 0)  # nothing is chosen: no area
    box.value = True
    until(lambda: boxes(page)[0][0] > 100)


def natural_sizes(page: Any) -> dict[str, list[int]]:
    """Width and height of the image files of the tiles, pixels."""
    found: dict[str, list[int]] = page.evaluate(
        """() => Object.fromEntries([...document.querySelectorAll("[data-humansim=tiles] figure")].map(
            (figure) => {
                const image = figure.querySelector("img");
                return [figure.dataset.humansim, [image.naturalWidth, image.naturalHeight]];
            }))"""
    )
    return found


@needs_browser
@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.process
def test_a_large_tile_has_all_pixels_of_its_camera(opened: tuple[Any, Any]) -> None:
    page, app = opened
    scrub(page, 8)
    until(lambda: natural_sizes(page)["wide rgb"] == [426, 142])  # a third of what all tiles have
    wide = page.get_by_role("button", name="wide", exact=True)
    wide.click()
    until(lambda: natural_sizes(page)["wide rgb"] == [480, 160])
    assert natural_sizes(page)["tall rgb"] == [200, 400]
    with Simulation(Scene.load(app.source.scene.path), channels=("rgb",)) as simulation:
        expected = simulation.frame(8).views["wide"].rgb.astype(float)
    until(lambda: np.abs(tiles_of(page).get("wide rgb", 0) - expected).mean() < 2)  # JPEG
    wide.click()
    until(lambda: natural_sizes(page)["wide rgb"] == [426, 142])


def downloaded(page: Any, button: str, folder: Path) -> Path:
    """The file that the page gives when a button whose name begins with these words is pressed."""
    with page.expect_download(timeout=30_000) as download:
        page.get_by_role("button", name=re.compile(f"^{button}")).click()
    path = folder / str(download.value.suggested_filename)
    download.value.save_as(path)
    return path


@needs_browser
@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.process
def test_a_picture_is_what_the_page_shows(opened: tuple[Any, Any], tmp_path: Path) -> None:
    page, _ = opened
    page.set_viewport_size({"width": 1280, "height": 800})
    page.wait_for_timeout(1500)
    file = downloaded(page, "Picture", tmp_path)
    assert file.name.startswith("lab_") and file.suffix == ".png"
    page.screenshot(path=str(tmp_path / "screen.png"))
    picture, screen = (cv2.imread(str(path)).astype(float) for path in (file, tmp_path / "screen.png"))
    scene, area, _tiles = boxes(page)
    assert picture.shape[:2] == (2 * round(scene[3] / 2), 2 * round(scene[2] / 2))
    # without the buttons and messages over the scene
    beside = screen[:700, : int(area[2])], picture[:700, : int(area[2])]
    within = screen[250:700, int(scene[0]) : int(scene[2])], picture[250:700, int(scene[0]) : int(scene[2])]
    for shown, saved in (beside, within):
        assert shown.std() > 5  # there is something
        assert np.abs(shown - saved).mean() < 3


@needs_browser
@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.process
def test_a_video_shows_the_motion(opened: tuple[Any, Any], tmp_path: Path) -> None:
    page, _ = opened
    page.get_by_role("button", name="Play", exact=True).click()
    page.get_by_role("button", name="Record video").click()
    page.wait_for_timeout(6000)
    path = downloaded(page, "Stop recording", tmp_path)
    pause(page)
    assert path.suffix == ".mp4"
    video = cv2.VideoCapture(str(path))
    assert int(video.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little") in (b"h264", b"avc1", b"FMP4")
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1].astype(float))
    scene, area, _tiles = boxes(page)
    assert len(frames) >= 2 and frames[0].shape[:2] == (2 * round(scene[3] / 2), 2 * round(scene[2] / 2))
    start, end = (int(area[2]) + 20, int(scene[2]))
    assert np.abs(frames[-1][:, start:end] - frames[0][:, start:end]).max() > 60  # the person has moved
    still = downloaded(page, "Picture", tmp_path)  # beside the moving images and people, they are the same
    corner = slice(-60, None), slice(end - 200, end)
    assert np.abs(cv2.imread(str(still)).astype(float)[corner] - frames[-1][corner]).mean() < 6
    page.get_by_role("button", name="Record video").wait_for()
