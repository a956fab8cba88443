"""The page of humansim view in a headless Chromium."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

pytest.importorskip("viser")
pytest.importorskip("playwright")

from labs import lab
from pages import (
    needs_browser,
    opened_page,
    pause,
    scrub,
    served,
    tab,
    three_vertices,
    tiles_of,
    tracks_of,
    until,
)
from waiting import PATIENCE, wait_until

from humansim_ros import Scene, Simulation
from humansim_ros.view.panels.stage import PageBody

pytestmark = [needs_browser, pytest.mark.nightly, pytest.mark.slow, pytest.mark.process]

SCENE = lab(
    30,
    {
        "left": "position: [3, 2, 1.6], look_at: [0, 0, 1], size: [320, 240]",
        "right": "position: [3, -2, 1.6], look_at: [0, 0, 1], size: [320, 240]",
    },
)
#: Pictures of the docs are made by these tests: HUMANSIM_PICTURES=docs/images.
PICTURES = os.environ.get("HUMANSIM_PICTURES")


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("view") / "lab.yaml"
    path.write_text(SCENE)
    return path


@pytest.fixture(scope="module")
def url(scene_file: Path) -> Iterator[str]:
    with served(str(scene_file), "--port", "0") as (address, _):
        yield address


@pytest.fixture
def page(chromium: Any, url: str) -> Iterator[Any]:
    opened = opened_page(chromium, url, people=2)
    yield opened
    opened.close()


def body_key(page: Any, body: PageBody) -> str:
    """Key of a body in the page: there is one with as many vertices and this texture."""
    table = page.evaluate("fetch('/humansim/people.json').then((answer) => answer.json())")
    (key,) = (key for key, entry in table.items() if entry["vertices"] == len(body.vertices))
    return str(key)


def same_images(left: Any, right: Any) -> bool:
    return list(left) == list(right) and all(np.array_equal(left[name], right[name]) for name in left)


def test_people_move_while_it_plays(page: Any) -> None:
    before = page.evaluate("window.humansim.frame")
    page.wait_for_function(f"window.humansim.frame !== {before}")


def test_a_scrub_shows_that_frame(page: Any, scene_file: Path) -> None:
    pause(page)
    scrub(page, 17)
    scene = Scene.load(scene_file)
    with Simulation(scene, channels=("rgb",)) as simulation:
        expected = {f"{name} rgb": view.rgb for name, view in simulation.frame(17).views.items()}
        other = {f"{name} rgb": view.rgb for name, view in simulation.frame(40).views.items()}

    def difference(images: Any) -> float:
        shown = tiles_of(page)
        if shown.keys() != images.keys():
            return np.inf
        return float(np.mean([np.abs(shown[name].astype(float) - images[name]).mean() for name in images]))

    until(lambda: difference(expected) < 2.0)  # JPEG
    assert difference(other) > 2 * difference(expected)


def test_three_js_poses_the_skin_as_we_do(page: Any, scene_file: Path) -> None:
    pause(page)
    scrub(page, 23)
    scene = Scene.load(scene_file)
    for actor in scene.actors.values():
        body = PageBody(actor.human)
        expected = actor.at(scene.frame_time(23) * 1e-9).vertices
        key = body_key(page, body)
        numbers = list(range(0, len(expected), 97))
        found = three_vertices(page, key, numbers)
        # four bones per vertex in the page, all of them in ours
        assert np.median(np.linalg.norm(found - expected[numbers], axis=1)) < 1e-4
        assert np.linalg.norm(found - expected[numbers], axis=1).max() < 5e-3


def test_a_face_moves_in_three_js_and_rests_again(chromium: Any, tmp_path: Path) -> None:
    path = tmp_path / "face.yaml"
    path.write_text(
        "room: null\nrate: 10\n"
        "humans: {anna: {body: adult_woman, motion: stand, face: {keys: ["
        "{actions: {jawOpen: 0.8, cheekPuff: 1}}, {time: 1, actions: {}, blend: 0}]}}}\n"
        "cameras: {front: {position: [3, 0, 1.6], look_at: [0, 0, 1.5], size: [320, 240]}}\n"
    )
    scene = Scene.load(path)
    actor = scene.actors["anna"]
    vertices = {frame: actor.at(scene.frame_time(frame) * 1e-9).vertices for frame in (3, 15)}
    change = np.linalg.norm(np.subtract(*vertices.values()), axis=1)
    numbers = np.argsort(-change)[:400:20].tolist()
    assert change[numbers].min() > 0.005
    with served(str(path), "--port", "0") as (address, _):
        page = opened_page(chromium, address)
        pause(page)
        for frame, expected in vertices.items():
            scrub(page, frame)
            key = body_key(page, PageBody(actor.human))

            def off(key: str = key, expected: Any = expected) -> float:
                found = three_vertices(page, key, numbers)
                return float(np.linalg.norm(found - expected[numbers], axis=1).max())

            until(lambda: off() < 2e-3)
        page.close()


def test_two_tabs_show_the_same_frame(page: Any, chromium: Any, url: str) -> None:
    other = opened_page(chromium, url, people=2)
    try:
        pause(page)
        scrub(page, 9)
        other.wait_for_function("window.humansim.frame === 9")
        until(lambda: tiles_of(page) and same_images(tiles_of(page), tiles_of(other)))
    finally:
        other.close()


def test_a_reload_shows_the_same_frame(page: Any) -> None:
    pause(page)
    scrub(page, 31)
    page.reload()
    page.wait_for_function("window.humansim && window.humansim.textured >= 2 && window.humansim.frame === 31")


def test_a_click_in_an_image_shows_the_numbers_of_the_pixel(page: Any, scene_file: Path) -> None:
    pause(page)
    scrub(page, 5)
    with Simulation(Scene.load(scene_file)) as simulation:
        frame = simulation.frame(5)
    view = frame.views["left"]
    rows, columns = np.nonzero(view.instance == 1)
    middle = len(rows) // 2
    x, y = int(columns[middle]), int(rows[middle])
    image = page.locator("[data-humansim='left rgb'] img")
    box = image.bounding_box()
    across, down = (x + 0.5) / 320, (y + 0.5) / 240
    image.click(position={"x": across * box["width"], "y": down * box["height"]})
    page.get_by_role("tab", name="Numbers").click()
    page.get_by_text("optical frame").wait_for()
    table = page.inner_text("table")
    assert "left" in table and "anna" in table
    # the image is drawn smaller than it is, so that a click may hit a neighbour
    near = view.depth[max(0, y - 2) : y + 3, max(0, x - 2) : x + 3]
    assert any(f"{depth:.4f} m" in table for depth in near.ravel())


def test_a_page_without_webgl_says_so(chromium: Any, url: str) -> None:
    page = chromium.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(url)
    page.get_by_text("This browser has no WebGL 2").wait_for()
    page.close()


def test_a_scene_with_an_error_is_told_with_its_line_until_it_is_mended(
    chromium: Any, tmp_path: Path
) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text(SCENE.replace("body: adult_man", "body: adult_mann"))
    with served(str(path), "--port", "0") as (address, _):
        page = chromium.new_page()
        page.set_default_timeout(1000 * PATIENCE)
        page.goto(address)
        page.get_by_text("wrong.yaml:5").wait_for()
        path.write_text(SCENE)
        page.wait_for_function("window.humansim.people === 2")
        until(lambda: page.get_by_text("wrong.yaml:5").count() == 0)
        path.write_text(SCENE + "rate: fast\n")
        page.get_by_text("wrong.yaml").first.wait_for()
        page.wait_for_function("window.humansim.people === 2")  # the last state that could be shown
        page.close()


def test_the_pictures_of_the_docs(chromium: Any) -> None:
    """The demo scene at the sizes of a laptop and a tablet."""
    with served("--port", "0") as (address, _):
        page = opened_page(chromium, address)
        until(lambda: tiles_of(page))
        pause(page)
        scrub(page, 20)
        until(lambda: 0 < (table := tracks_of(page)).get("planned", 0) == len(table["sampled"]))
        page.get_by_label("Curve", exact=True).select_option("joint position")
        page.get_by_label("Joint of the curve").select_option("l_ankle")
        page.add_style_tag(content=".mantine-Notifications-root { opacity: 0 }")  # there is no GPU
        for name, width, height in (("view", 1280, 800), ("view_tablet", 800, 1200)):
            page.set_viewport_size({"width": width, "height": height})
            page.wait_for_timeout(1500)
            picture = page.screenshot(type="jpeg", quality=85)
            assert len(picture) > 30_000  # an empty page is smaller
            if PICTURES:
                (ROOT / PICTURES / f"{name}.jpg").write_bytes(picture)
        page.close()


#: Roles of controls in the accessibility tree of Chromium.
CONTROLS = {"button", "checkbox", "combobox", "link", "slider", "spinbutton", "tab", "textbox"}


def unnamed_controls(page: Any) -> list[str]:
    """Controls that a screen reader cannot name, from Chromium's accessibility tree: role and value."""
    session = page.context.new_cdp_session(page)
    nodes = session.send("Accessibility.getFullAXTree")["nodes"]
    session.detach()
    controls = [n for n in nodes if not n["ignored"] and n.get("role", {}).get("value") in CONTROLS]
    assert len(controls) > 10
    empty = [n for n in controls if not n.get("name", {}).get("value", "").strip()]
    return [f"{n['role']['value']} {n.get('value', {}).get('value', '')}" for n in empty]


def test_a_screen_reader_has_a_name_for_each_control(page: Any) -> None:
    for name in ("Show", "Numbers", "Edit", "Run"):
        tab(page, name)
        wait_until(lambda: not unnamed_controls(page), 20)
        assert unnamed_controls(page) == [], name
