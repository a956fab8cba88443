"""The timeline along the bottom of the page, in a real browser."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("viser")
pytest.importorskip("playwright")

from labs import write_estimate
from pages import browser, needs_browser, opened_page, pause, running_app, tracks_of, until, wait_for_tracks

from humansim_ros import Scene, Simulation
from humansim_ros.motion.body.skeleton import body_joints

pytestmark = [needs_browser, pytest.mark.nightly, pytest.mark.slow, pytest.mark.process]

SCENE = """\
rate: 30
room: null
humans:
  anna: {body: adult_woman, motion: {file: walk, position: [0.2, 0.4]}, keyframes: keys.xml}
  ben: {body: adult_man, motion: {file: wave, position: [-0.6, -0.2]}}
cameras:
  left: {position: [3, 2, 1.6], look_at: [0, 0, 1], size: [160, 120], faults: {drop: {probability: 0.2}}}
  right: {position: [3, -2, 1.6], look_at: [0, 0, 1], size: [160, 120]}
"""
SIZES = ((1280, 800), (800, 1200), (1000, 557))


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, Any]]:
    import numpy as np

    from humansim_ros.motion.files.keyframes import (
        Keyframes,
        KeyframeTimeline,
        KeyframeTrack,
        write_keyframes,
    )

    folder = tmp_path_factory.mktemp("timeline")
    timeline = KeyframeTimeline(0, 40, 30.0)
    zeros = np.zeros((2, 3))
    track = KeyframeTrack(timeline, np.array([0.0, 30.0]), zeros, zeros, zeros + 1)
    write_keyframes(folder / "keys.xml", Keyframes(timeline, {"anna": track}))
    path = folder / "lab.yaml"
    path.write_text(SCENE)
    write_estimate(path, folder / "poses.csv", 12, {"anna": 0.02})
    with running_app(path, str(folder / "poses.csv")) as app, browser() as chromium:
        page = opened_page(chromium, app.server.url, people=2)
        pause(page)
        page.get_by_role("slider", name="Time").wait_for()
        wait_for_tracks(page)
        yield page, app
        page.close()


def test_a_click_and_a_drag_move_the_time(opened: tuple[Any, Any]) -> None:
    page, app = opened
    last = app.player.frames - 1
    area = page.get_by_role("slider", name="Time")
    box = area.bounding_box()
    page.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + 10)
    page.wait_for_function(f"window.humansim.frame === {round(0.25 * last)}")
    page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 10)
    page.mouse.down()
    for share in (0.4, 0.6, 0.75):
        page.mouse.move(box["x"] + share * box["width"], box["y"] + 12)
    page.wait_for_function(f"window.humansim.frame === {round(0.75 * last)}")
    page.mouse.up()
    until(lambda: area.get_attribute("aria-valuenow") == str(round(0.75 * last)))
    cursor = page.locator("#humansim-timeline .cursor").bounding_box()
    assert cursor["x"] + 1 == pytest.approx(box["x"] + round(0.75 * last) / last * box["width"], abs=1.5)


def test_the_keyboard_moves_the_time_of_the_timeline(opened: tuple[Any, Any]) -> None:
    page, app = opened
    area = page.get_by_role("slider", name="Time")
    area.focus()
    for keys, frame in (
        (("Home",), 0),
        (("ArrowRight", "ArrowRight", "PageUp", "ArrowLeft"), 11),  # each counts from the one before
        (("End",), app.player.frames - 1),
    ):
        for key in keys:
            page.keyboard.press(key)
        page.get_by_role("slider", name="Time").and_(page.locator(f"[aria-valuenow='{frame}']")).wait_for()
    until(lambda: f"frame {app.player.frames - 1}," in area.get_attribute("aria-valuetext"))


def test_tracks_show_people_keyframes_visibility_and_drops(opened: tuple[Any, Any]) -> None:
    page, app = opened
    table = tracks_of(page)
    assert table["keys"] == {"anna": [0, 30]}
    assert 0 < len(table["drops"]["left"]) < table["frames"]
    with Simulation(Scene.load(app.source.scene.path), channels=("depth", "instance", "part")) as simulation:
        seen = simulation.frame(table["sampled"][5]).truth["right"].joints["ben"].visible
    body = body_joints(app.source.people["ben"].skeleton.joint_names)
    assert table["visible"]["ben"]["right"][5] == round(100 * float((seen[body] == 2).mean()))
    tracks = page.get_by_role("list", name="Tracks").get_by_role("listitem")
    names = [item.get_attribute("aria-label") for item in tracks.all()]
    assert names[0] == "anna, 2 keyframes" and names[3] == "ben"
    assert names[4].startswith("ben in left: ") and names[4].endswith("% of the joints visible, mean")
    assert names[-1] == f"drops left: {len(table['drops']['left'])} of {table['frames']} frames"


def test_curves_have_their_values_beside_the_cursor(opened: tuple[Any, Any]) -> None:
    page, app = opened
    page.get_by_label("Curve", exact=True).select_option("joint position")
    page.get_by_label("Person of the curve").select_option("ben")
    page.get_by_label("Joint of the curve").select_option("r_wrist")
    page.evaluate("fetch('/humansim/seek?frame=9')")
    page.wait_for_function("window.humansim.frame === 9")
    scene = Scene.load(app.source.scene.path)
    number = scene.actors["ben"].human.skeleton.joint_names.index("r_wrist")
    x, y, z = scene.actors["ben"].at(scene.frame_time(9) * 1e-9).joints[number, :3, 3]
    values = page.locator("#humansim-timeline .values")
    until(lambda: values.inner_text().split("\n") == [f"x {x:.2f} m", f"y {y:.2f} m", f"z {z:.2f} m"])
    page.get_by_label("Curve", exact=True).select_option("visibility")
    table = tracks_of(page)
    shown = {
        camera: table["visible"]["ben"][camera][table["sampled"].index(9)] for camera in ("left", "right")
    }
    until(lambda: values.inner_text().split("\n") == [f"{name} {value} %" for name, value in shown.items()])
    page.get_by_label("Curve", exact=True).select_option("estimate error")
    until(lambda: values.inner_text().split("\n") == ["anna 20 mm", "ben –"])
    page.get_by_label("Curve", exact=True).select_option("no curve")


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_the_timeline_never_covers_the_scene(opened: tuple[Any, Any], width: int, height: int) -> None:
    page, _ = opened
    page.set_viewport_size({"width": width, "height": height})
    bar = page.locator("#humansim-timeline")

    tiles = page.locator('[data-humansim="tiles"]')

    def end(area: Any) -> float:
        return float(area["y"] + area["height"])

    def fits() -> bool:
        """The scene, or the images below it, end where the timeline begins."""
        top, canvas = bar.bounding_box()["y"], page.locator("#root canvas").first.bounding_box()
        ends = end(canvas), end(tiles.bounding_box())
        return bool(abs(max(ends) - top) < 1.5 and canvas["height"] > 0.3 * height)

    until(fits)
    box = bar.bounding_box()
    assert box["x"] == 0 and box["width"] == width and box["y"] + box["height"] == height
    for control in bar.locator("button:visible, select:visible").all():
        inside = control.bounding_box()
        assert inside["x"] >= 0 and inside["x"] + inside["width"] <= width
        assert control.get_attribute("aria-label")
    page.get_by_role("button", name="Hide the tracks").click()
    until(lambda: bar.bounding_box()["height"] < 40)
    until(fits)
    page.get_by_role("button", name="Show the tracks").click()
    until(fits)


def test_a_low_page_has_room_for_the_tabs_beside_the_scroll_bar(
    opened: tuple[Any, Any],
) -> None:
    """The folder of the time, whose controls the timeline has, is folded."""
    first, app = opened
    page = opened_page(first.context.browser, app.server.url, people=2, size=(1000, 557))
    try:
        fold = page.locator(".mantine-Paper-root", has_text=re.compile("^Time$"))
        fold.locator(".tabler-icon-chevron-down").wait_for()

        def room() -> float:
            tabs = page.get_by_role("tab", name="Show", exact=True).bounding_box()
            return float(page.locator("#humansim-timeline").bounding_box()["y"] - tabs["y"] - tabs["height"])

        until(lambda: room() > 250)
        bar = page.locator('.mantine-ScrollArea-scrollbar[data-orientation="vertical"]:visible').first
        bar.wait_for()
        left = bar.bounding_box()["x"]
        panel = page.locator(".mantine-ScrollArea-content").filter(has=page.get_by_role("tab")).first
        rows = panel.locator(".mantine-Paper-root:visible, .mantine-Input-wrapper:visible").all()
        assert rows
        assert all(box["x"] + box["width"] <= left for row in rows if (box := row.bounding_box()))
        fold.click()  # whoever needs the folder opens it, and it stays open
        page.get_by_role("button", name=re.compile("^(Play|Pause)$")).wait_for()
    finally:
        page.close()


def test_hostile_requests_change_nothing(opened: tuple[Any, Any]) -> None:
    page, app = opened
    page.evaluate("fetch('/humansim/seek?frame=3')")
    page.wait_for_function("window.humansim.frame === 3")
    for query in ("seek?frame=-1", "seek?frame=nan", "seek", f"seek?frame={'9' * 5000}", "curve?person=x"):
        page.evaluate(f"fetch('/humansim/{query}')")
    page.evaluate("fetch('/humansim/seek?frame=99999999999')")
    page.wait_for_function(f"window.humansim.frame === {app.player.frames - 1}")
