"""The measure tool of the page in a real browser: its distances are those of the scene."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("viser")
pytest.importorskip("playwright")

from pages import needs_browser, paused_page, place_of, scrub, until, wait_for_tracks
from waiting import wait_until

from humansim_ros import Scene, Simulation
from humansim_ros.types import Array

pytestmark = [needs_browser, pytest.mark.nightly, pytest.mark.slow, pytest.mark.process]

SCENE = """\
room: null
humans:
  anna: {body: adult_woman, motion: {file: walk, position: [0.2, 0.4]}}
cameras:
  eye:
    {position: [4, 0.5, 1.8], look_at: [0, 0, 1],
     size: [480, 320], K: [[330, 0, 200], [0, 310, 140], [0, 0, 1]]}
  left: {position: [0.5, 1.6, 1.9], look_at: [0, 0, 1]}
  right: {position: [0.3, -1.7, 1.4], look_at: [0, 0, 1]}
"""
SHOWN, SIZE = 12, (480, 320)


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, Any, Any]]:
    """Page, app and frame; the page shows the 3D view from the position of a camera."""
    path: Path = tmp_path_factory.mktemp("measure") / "lab.yaml"
    path.write_text(SCENE)
    with Simulation(Scene.load(path), channels=("depth", "instance")) as simulation:
        frame = simulation.frame(SHOWN)
    with paused_page(path) as (page, app):
        wait_for_tracks(page)
        scrub(page, SHOWN)
        through = app._through
        through._choice.value, through._kind.value = "eye", "3D from its position"
        app.post(through._choose)
        page.wait_for_function("window.humansim.page.through && !window.humansim.page.through.lens")
        look_from(page, frame.cameras["eye"].center)
        yield page, app, frame


def look_from(page: Any, center: Array) -> None:
    """Wait until the 3D view rests at a place (3,) in ``map``: a view that moves turns, too."""
    script = "() => { const p = window.humansim.camera.position; return [-p.z, -p.x, p.y] }"

    def rests() -> bool:
        before = page.evaluate(script)
        page.wait_for_timeout(200)
        return before == page.evaluate(script) and np.allclose(before, center, atol=1e-3)

    until(rests)


def pixel_of(frame: Any, point: Array) -> tuple[float, float]:
    pixels, _ = frame.cameras["eye"].project([point])
    return float(pixels[0][0]), float(pixels[0][1])


def click(page: Any, pixel: tuple[float, float]) -> None:
    page.mouse.move(*place_of(page, pixel, SIZE))
    page.mouse.down()
    page.mouse.up()


def measured(page: Any) -> list[tuple[Array, Array, float]]:
    """Ends (3,) in ``map`` and distance of each measure, metres."""
    found = page.evaluate("window.humansim.measures.map((m) => [m.from.at, m.to.at, m.distance])")
    return [(np.array(start), np.array(end), distance) for start, end, distance in found]


def measure(page: Any, frame: Any, start: Array, end: Array) -> tuple[Array, Array, float]:
    """Measure between two points (3,) in ``map`` by two clicks where they are drawn."""
    button = page.get_by_role("button", name="Measure", exact=True)
    if button.get_attribute("aria-pressed") == "false":
        button.click()
    before = len(measured(page))
    click(page, pixel_of(frame, start))
    click(page, pixel_of(frame, end))
    until(lambda: len(measured(page)) > before and measured(page)[-1][2] > 0)
    return measured(page)[-1]


def test_a_measure_between_two_cameras_is_their_distance(opened: tuple[Any, Any, Any]) -> None:
    page, _app, frame = opened
    left, right = frame.cameras["left"].center, frame.cameras["right"].center
    start, end, distance = measure(page, frame, left, right)
    assert np.allclose(start, left, atol=1e-5) and np.allclose(end, right, atol=1e-5)
    assert distance == pytest.approx(np.linalg.norm(right - left), abs=1e-4)
    page.get_by_text(f"{distance:.3f} m", exact=True).wait_for()
    dx, dy, dz = right - left
    page.get_by_text(f"dx {dx:.3f}, dy {dy:.3f}, dz {dz:.3f} m", exact=True).wait_for()


def test_a_measure_between_joints_is_their_distance_and_follows_them(opened: tuple[Any, Any, Any]) -> None:
    page, app, frame = opened
    truth = frame.humans["anna"].positions
    names = app.source.people["anna"].skeleton.joint_names
    wrist, top = names.index("r_wrist"), names.index("vt3_end")  # a bone, and an end point
    _, _, distance = measure(page, frame, truth[wrist], truth[top])
    assert distance == pytest.approx(np.linalg.norm(truth[top] - truth[wrist]), abs=1e-3)
    with Simulation(Scene.load(app.source.scene.path), channels=()) as simulation:
        later = simulation.frame(SHOWN + 15).humans["anna"].positions
    expected = float(np.linalg.norm(later[top] - later[wrist]))
    assert abs(expected - distance) > 0.01
    scrub(page, SHOWN + 15)
    until(lambda: abs(measured(page)[-1][2] - expected) < 1e-3)
    scrub(page, SHOWN)
    until(lambda: abs(measured(page)[-1][2] - distance) < 1e-4)


def test_a_measure_on_the_floor_and_on_a_person_is_where_the_click_is(opened: tuple[Any, Any, Any]) -> None:
    page, app, frame = opened
    camera, view = frame.cameras["eye"], frame.views["eye"]
    rows, columns = np.nonzero(cv2.erode((view.instance == 1).astype(np.uint8), np.ones((7, 7))))
    joints = camera.project(frame.humans["anna"].positions)[0]
    far = np.linalg.norm(joints[None] - np.stack([columns, rows], axis=1)[:, None], axis=2).min(axis=1)
    column, row = int(columns[far.argmax()]), int(rows[far.argmax()])
    body = camera.unproject([[column, row]], [view.depth[row, column]])[0]
    floor = np.array([1.5, -0.8, 0.0])
    start, end, distance = measure(page, frame, floor, body)
    pixel = 4.0 / 310  # of the image, at the distance of the person, metres
    assert np.linalg.norm(start - floor) < 2 * pixel  # the floor is seen at an angle
    assert np.linalg.norm(end - body) < 1.5 * pixel
    assert distance == pytest.approx(np.linalg.norm(end - start))
    assert app.player.index == SHOWN
    assert page.get_by_text("vertex").count() == 0  # a click of the tool does not ask for numbers


def test_pictures_have_measures_and_escape_ends_and_clears_them(
    opened: tuple[Any, Any, Any], tmp_path: Path
) -> None:
    page, _, frame = opened
    measure(page, frame, frame.cameras["left"].center, frame.cameras["right"].center)
    ink = np.array([0x5C, 0x25, 0xC2])  # BGR

    def inked() -> int:
        with page.expect_download(timeout=30_000) as download:
            page.get_by_role("button", name="Picture", exact=True).click()
        download.value.save_as(tmp_path / "picture.png")
        picture = cv2.imread(str(tmp_path / "picture.png")).astype(int)
        return int((np.abs(picture - ink).max(axis=2) < 12).sum())

    assert inked() > 300
    click(page, pixel_of(frame, frame.cameras["left"].center))
    count = len(measured(page))
    page.keyboard.press("Escape")  # drops the first end
    click(page, pixel_of(frame, frame.cameras["right"].center))
    assert len(measured(page)) == count
    button = page.get_by_role("button", name="Measure", exact=True)
    page.keyboard.press("Escape")
    assert button.get_attribute("aria-pressed") == "true"
    page.keyboard.press("Escape")
    assert wait_until(lambda: button.get_attribute("aria-pressed") == "false", 10)
    assert len(measured(page)) == count
    page.keyboard.press("Escape")
    until(lambda: measured(page) == [])
    assert inked() < 50
