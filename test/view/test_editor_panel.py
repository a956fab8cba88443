"""The panel that edits the scene of a page: what its controls do to the file and to the page."""

from __future__ import annotations

import json
import shutil
import signal
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from labs import write_estimate
from pages import told_app
from scipy.spatial.transform import Rotation
from stand_ins import STAND_INS
from waiting import wait_until

from humansim_ros.errors import HumansimError
from humansim_ros.people import load_human
from humansim_ros.scene import Scene
from humansim_ros.view.edit.document import SceneDocument
from humansim_ros.view.edit.edits import keyframe_times
from humansim_ros.view.panels.editor import EditorPanel

pytest.importorskip("viser")

from msgspec.msgpack import encode
from test_server import CAMERA, connected

from humansim_ros.view.sources.inputs import open_source

#: The demo scene without its room, which takes time.
DEMO = (ROOT / "config/scenes/demo.yaml").read_text().replace("room:\n  size: [7.0, 6.4, 2.8]", "room: null")


class Page:
    """A page on a copy of the demo scene, without a browser; what users do is called directly."""

    def __init__(self, path: Path) -> None:
        opened = open_source(path)
        self.path = path
        self.app, self.told = told_app(opened)
        assert self.app.editor is not None
        self.editor: EditorPanel = self.app.editor
        self.document: SceneDocument = self.editor.document

    def control(self, key: str) -> Any:
        return self.editor.controls_now().control(key)

    def type(self, key: str, value: Any) -> None:
        """What a user types into a control."""
        control = self.control(key)
        control.handle.value = value
        self.editor.controls_now().changed(control)


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    yield from opened(tmp_path)


@pytest.fixture(scope="module")
def unchanged_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A page for tests that do not change it."""
    yield from opened(tmp_path_factory.mktemp("page"))


def opened(folder: Path) -> Iterator[Page]:
    path = folder / "scene.yaml"
    path.write_text(DEMO)
    page = Page(path)
    yield page
    page.app.close()


@pytest.mark.nightly
def test_people_objects_and_cameras_are_added_duplicated_renamed_and_removed(page: Page) -> None:
    editor = page.editor
    editor.add("humans")
    assert editor.selected == "person person" and "person" in page.app.source.people
    editor.add("objects")
    editor.add("cameras")
    assert "camera_5" in page.app.source.cameras
    editor.duplicate()
    assert editor.item == ("cameras", "camera_6")
    editor.rename("top")
    assert editor.item == ("cameras", "top") and "top" in page.app.source.cameras
    editor.rename("two words")
    assert "letters, digits" in page.told[-1] and editor.item == ("cameras", "top")
    editor.remove_selected()
    assert "top" not in page.app.source.cameras and editor.selected == "scene"
    for _ in range(6):
        editor.undo()
    assert page.document.text() == DEMO
    assert list(page.app.source.people) == ["walker"]
    editor.redo()
    assert "person" in page.app.source.people


@pytest.mark.nightly
def test_a_drag_of_the_gizmo_places_the_item(page: Page) -> None:
    page.editor.select("person walker")
    gizmo = page.app.server.viser.scene._handle_from_node_name["/editor"]
    np.testing.assert_allclose(gizmo.position, [0, -1.59, 0])
    turned = Rotation.from_euler("z", 90, degrees=True).as_quat()
    page.editor.move(np.array([1.0, 0.5, 0.0]), turned)
    assert page.document.value("humans.walker.motion.position") == [1, 0.5]
    assert page.document.value("humans.walker.motion.yaw_deg") == 90
    assert page.document.steps() == (["Move walker"], [])
    page.editor.move(np.array([1.0, 0.5, 0.0]), -turned)
    assert len(page.document.steps()[0]) == 1  # it was not moved
    page.editor.select("camera camera_1")
    pose = page.document.pose("cameras", "camera_1")
    page.editor.move(np.array([2.0, 2.0, 2.0]), pose.quaternion)
    assert page.document.value("cameras.camera_1.look_at") == [0, 0, 0.8]
    np.testing.assert_allclose(page.app.source.cameras["camera_1"].center, [2, 2, 2])


@pytest.mark.nightly
def test_controls_of_all_sections_change_their_keys_and_show_what_is_wrong_in_place(page: Page) -> None:
    page.editor.select("camera camera_1")
    page.type("fov_deg", "75")
    assert page.document.value("cameras.camera_1.fov_deg") == 75
    page.type("sensor.exposure_time", 0.01)
    page.type("sensor.noise", True)
    page.type("sensor.noise.full_well", 5000.0)
    assert page.document.value("cameras.camera_1.sensor.noise") == {"full_well": 5000}
    page.type("fov_deg", "200")
    assert "below 180" in page.control("fov_deg").error
    assert page.app.source.cameras["camera_1"].K[0, 0] == pytest.approx(
        319.5 / np.tan(np.radians(37.5)), rel=0.01
    )
    page.type("fov_deg", "75: [")
    assert "not valid YAML" in page.control("fov_deg").error
    page.type("fov_deg", "60")
    assert page.control("fov_deg").error is None
    page.type("sensor.noise", False)
    assert page.document.value("cameras.camera_1.sensor.noise") is None
    page.editor.select("person walker")
    page.type("body", "child")
    page.type("motion.file", "wave")
    page.type("motion.loop", "repeat")
    page.type("motion.mirror", True)
    assert page.app.source.people["walker"].name == "child"
    page.editor.select("light")
    page.type("shadows", "soft")
    page.type("sun", "[0, 0, 1]")
    assert page.document.errors() == []
    assert Scene.load(page.path).config.light.shadows == "contact"  # not saved


@pytest.mark.nightly
def test_every_selection_shows_its_keys_with_the_values_of_the_file(page: Page) -> None:
    page.editor.add("objects")
    for choice in page.editor.choices():
        page.editor.select(choice)
        assert page.editor.selected == choice
        for keys, control in page.editor.controls_now().controls.items():
            value = page.document.value(keys)
            if isinstance(value, (bool, int, float)) and not isinstance(control.handle.value, str):
                assert control.handle.value == value, keys
    page.editor.select("scene")
    page.type("rate", 12)
    assert page.app.source.period == round(1e9 / 12)


@pytest.mark.nightly
def test_keys_are_added_where_the_gizmo_is_dragged_at_the_time_shown(page: Page) -> None:
    page.editor.select("person walker")
    keyframes = page.editor.keyframes
    keyframes.use("Add")
    page.app.seek(45)
    page.editor.place_gizmo()
    keyframes._dragging.value = True
    assert keyframes.dragging
    page.editor.move(np.array([1.0, 0.0, 0.0]), np.array([0, 0, 0, 1.0]))
    assert keyframe_times(page.document, "humans", "walker") == [0, 1.5]
    np.testing.assert_allclose(page.document.pose("humans", "walker", 1.5).position, [1, 0, 0], atol=2e-4)
    assert keyframes._times.content == "keys at 0, 1.5 s"
    page.app.seek(45)
    keyframes.use("Remove")
    assert keyframe_times(page.document, "humans", "walker") == [0]


@pytest.mark.nightly
def test_a_calibration_is_loaded_and_idealised_with_its_command(page: Page) -> None:
    shutil.copy(page.path, page.path.parent / "cameras.yaml")
    page.editor.calibration.load("cameras.yaml", as_file=True)
    assert "already" in page.document.errors()[0].message  # of the same names
    page.document.remove("cameras")
    page.editor.refresh()
    assert page.document.errors() == [] and page.app.source.cameras["camera_1"].center[2] == pytest.approx(
        2.2
    )
    page.editor.select("rig")
    page.editor.calibration.idealize(True)
    assert page.document.value("rig.file") == "ideal/cameras.yaml"
    assert "humansim camera idealize" in page.editor._command.content
    page.editor.calibration.load("/etc/passwd")
    assert "/etc/passwd" in page.told[-1]
    page.editor.calibration.load("missing.toml")
    assert "missing.toml" in page.told[-1]


@pytest.mark.nightly
def test_files_of_people_do_not_grow_over_edits(page: Page) -> None:
    def served() -> list[str]:
        files = page.app.server.files
        people = sorted(path for path in files if path.startswith("/humansim/people/"))
        named = json.loads(files["/humansim/people.json"][1]).values()
        assert people == sorted(entry[key] for entry in named for key in ("surface", "texture", "shapes"))
        return people

    at_first = served()
    assert [path.rsplit(".", 1)[1] for path in at_first] == ["jpg", "shapes", "surface"]
    page.editor.select("person walker")
    for x in (1.0, 2.0):
        page.editor.move(np.array([x, 0.5, 0.0]), np.array([0, 0, 0, 1.0]))
        assert len(served()) == 3 and served() != at_first
    frame, before = page.app.source.frame(0), dict(page.app.server.files)
    for size in (1.1, 0.9):
        page.app._stage.show(replace(frame, sizes={"walker": size}))
        assert page.app._stage._bodies["walker"][0].size == size
    assert page.app.server.files == before


@pytest.mark.nightly
def test_messages_that_posted_functions_cannot_use_do_not_end_the_page(
    page: Page, caplog: pytest.LogCaptureFixture
) -> None:
    page.editor.select("person walker")
    thread = threading.Thread(target=page.app.run)
    thread.start()
    click = {
        "type": "SceneNodeClickMessage",
        "name": "/people/walker",
        "instance_index": None,
        "ray_origin": [3.0, -1.59, 1.0],
        "ray_direction": [-1.0, 0.0, 0.0],
        "screen_pos": [0.5, 0.5],
        "modifier": None,
    }
    drag = {"type": "TransformControlsUpdateMessage", "name": "/editor"}
    at_first: list[float] = page.document.pose("humans", "walker", 0.0).position.tolist()
    good = {"wxyz": [1.0, 0.0, 0.0, 0.0], "position": [at_first[0] + 1, *at_first[1:]]}
    try:
        with connected(page.app.server) as browser:
            browser.send(encode(CAMERA))
            assert wait_until(lambda: page.app._frame is not None)
            for wrong in ({"ray_origin": [0.0, 1.0]}, {"ray_direction": [1.0] * 5}):
                told = len(page.told)
                browser.send(encode(click | wrong))
                assert wait_until(lambda told=told: len(page.told) > told)
            assert "could not do what a browser asked for" in caplog.text
            for wrong in ({"position": [1.0]}, {"wxyz": [1.0] * 3}):
                told = len(page.told)
                for _ in range(4):  # a drag of a gizmo that is just made again is dropped
                    browser.send(encode(drag | good | wrong))
                    browser.send(encode({"type": "TransformControlsDragEndMessage", "name": "/editor"}))
                    if wait_until(lambda told=told: len(page.told) > told, 15):
                        break
                assert len(page.told) > told
            assert page.document.steps() == ([], [])
            browser.send(encode(drag | good))
            browser.send(encode({"type": "TransformControlsDragEndMessage", "name": "/editor"}))
            assert wait_until(lambda: page.document.steps()[0] == ["Move walker"])
    finally:
        page.app.stop()
        thread.join()


@pytest.mark.nightly
def test_the_motion_of_a_person_is_shown_as_a_picture(page: Page) -> None:
    page.editor.select("person walker")
    walking = page.editor.picture._image
    page.type("motion.file", "wave")
    assert page.editor.picture._image is not walking
    page.editor.select("light")
    assert not page.editor.picture._folder.visible


@pytest.mark.nightly
def test_a_saved_scene_is_what_the_page_shows(page: Page) -> None:
    page.editor.add("humans")
    page.editor.save(str(page.path))
    assert list(Scene.load(page.path).actors) == ["walker", "person"]
    assert not page.document.changed
    page.path.write_text(page.path.read_text() + "# theirs\n")
    page.editor.add("humans")
    page.editor.save(str(page.path))
    assert "another program has changed this file" in page.told[-1]
    page.editor.save(str(page.path), overwrite=True)
    assert "# theirs" not in page.path.read_text()


@pytest.mark.nightly
def test_the_outfits_on_offer_are_of_the_body(page: Page) -> None:
    page.editor.select("person walker")
    for body in ("adult_man", "child", "adult_woman"):
        page.type("body", body)
        outfits = load_human(body).outfits
        assert set(outfits) <= set(page.control("outfit").handle.options)
        page.type("outfit", outfits[-1])
        assert page.document.errors() == []
        others = set(page.control("outfit").handle.options) - set(outfits)
        assert others == {"(default)"}


@pytest.mark.nightly
def test_another_body_leaves_an_outfit_that_it_does_not_have_in_one_step(page: Page) -> None:
    first, second = load_human("adult_woman").outfits, load_human("adult_man").outfits
    worn = next(name for name in first if name not in second)
    page.document.set("humans.walker.body", "adult_woman")
    page.document.set("humans.walker.outfit", worn)
    page.editor.refresh()
    page.editor.select("person walker")
    before = page.document.text()
    page.type("body", "adult_man")
    assert page.document.errors() == [] and page.document.value("humans.walker.outfit") is None
    assert worn in page.told[-1]
    page.editor.undo()
    assert page.document.text() == before


@pytest.mark.nightly
def test_an_estimate_of_the_tab_is_shown_beside_the_truth_and_survives_edits(page: Page) -> None:
    assert page.app.commands is not None
    write_estimate(page.path, page.path.parent / "poses.csv", 3, {"walker": 0.02})
    page.app.commands.estimate.take("poses.csv")
    assert "--estimate poses.csv" in page.app.commands._text.value
    for _ in range(2):
        assert page.app.source.frame(1).estimate_errors == {"walker": pytest.approx(20.0, abs=0.1)}
        page.editor.set(("rate",), page.document.value("rate"))
        page.editor.show_scene()
    page.app.commands.estimate.take("")
    assert page.app.source.frame(1).estimate_errors == {}
    (page.path.parent / "boxes.json").write_text('[{"image_id": 1, "bbox": [0, 0, 1, 1], "score": 1}]')
    page.app.commands.estimate.take("boxes.json")
    assert "is detections in images" in page.told[-1]


def test_a_scene_with_errors_is_saved_only_after_a_question(page: Page) -> None:
    before = page.path.read_text()
    page.document.set("rate", -5)
    page.editor.save(str(page.path))
    assert page.editor.question is not None and page.path.read_text() == before
    page.editor.save(str(page.path), wrong=True)
    assert "rate: -5" in page.path.read_text()


def test_an_error_of_a_top_level_key_stands_in_the_folder_of_its_control(page: Page) -> None:
    page.editor.select("scene")
    page.type("rate", -5)
    control = page.control("rate")
    assert control.error is not None
    own = [control.handle, control._error]
    assert {handle._impl.parent_container_id for handle in own} == {page.editor._keys._impl.uuid}


@pytest.mark.nightly
def test_commands_run_on_the_saved_scene_with_their_progress_and_can_be_stopped(page: Page) -> None:
    commands = page.app.commands
    assert commands is not None
    page.editor.add("humans")
    commands.choose("record")
    commands.toggle()
    assert "save it first" in page.told[-1] and commands.job is None
    page.editor.undo()
    commands.start("humansim export scene.yaml -o out --format no_such_format --frames 2")
    job = commands.job
    assert job is not None
    assert wait_until(lambda: job.code is not None)
    commands.update()
    assert job.code == 2 and job.state == "has failed with exit code 2"
    assert any("no_such_format" in line for line in job.lines)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as in a background job of a shell
    commands.start("humansim record scene.yaml -o bag --frames 1000000")
    signal.signal(signal.SIGINT, before)
    running = commands.job
    assert running is not None and running is not job and running.code is None
    running.take_line("250000 of 1000000 frames, 30 camera-frames/s\x1b[2J")
    assert running.progress == 0.25 and "\x1b" not in running.lines[-1]
    commands.toggle()
    assert wait_until(lambda: running.code is not None)
    assert running.state == "was stopped"


def refusal_of(page: Page, line: str) -> str:
    """Start a command line that the page does not take; returns what it says."""
    assert page.app.commands is not None
    page.app.commands.start(line)
    assert page.app.commands.job is None
    return page.told[-1]


@pytest.mark.parametrize(
    "line", ["", "rm -rf /", "humansim", "humansim clear", "humansim run 'x", "humansim run a\0b"]
)
def test_only_commands_of_the_scene_are_started(line: str, unchanged_page: Page) -> None:
    refusal = refusal_of(unchanged_page, line)
    assert "humansim" in refusal or "cannot be read" in refusal


@pytest.mark.parametrize(
    "line",
    [
        "humansim export scene.yaml -o /tmp/elsewhere",
        "humansim export scene.yaml -o/tmp/elsewhere",
        "humansim export scene.yaml --output=../elsewhere",
        "humansim run ../scene.yaml",
        "humansim record scene.yaml -o s3://bucket/bag",
        "humansim evaluate --truth scene.yaml --estimate ~/estimate.csv",
    ],
)
def test_commands_name_files_below_the_folder_of_the_scene_only(line: str, unchanged_page: Page) -> None:
    assert "below" in refusal_of(unchanged_page, line)


def test_the_page_saves_and_names_files_below_the_folder_of_the_scene_only(unchanged_page: Page) -> None:
    page = unchanged_page
    page.editor.save(str(page.path.parent.parent / "elsewhere.yaml"))
    assert "below" in page.told[-1] and not (page.path.parent.parent / "elsewhere.yaml").exists()
    with pytest.raises(HumansimError, match="below"):
        page.editor.set(("humans", "walker", "body"), "/etc/passwd")


@pytest.mark.nightly
def test_a_file_that_others_change_is_shown_unless_there_are_edits(page: Page) -> None:
    page.path.write_text(page.path.read_text().replace("walker", "runner"))
    assert page.editor.file_changed()
    page.editor.refresh()
    assert page.document.names("humans") == ["runner"]
    page.editor.add("humans")
    page.path.write_text(page.path.read_text().replace("runner", "jogger"))
    assert not page.editor.file_changed()
    assert "Another program has changed the file" in page.told[-1]
    assert page.document.names("humans") == ["runner", "person"]


def test_a_file_that_is_broken_while_it_is_shown_keeps_the_panel_alive(page: Page) -> None:
    good = page.path.read_text()
    page.path.write_text(good.replace("rate: 30", "rate: ["))
    assert page.editor.file_changed()
    page.editor.refresh()
    assert page.document.errors() and list(page.app.source.people) == ["walker"]
    page.editor.add("humans")
    assert "not valid YAML" in page.told[-1]
    page.path.write_text(good)
    assert page.editor.file_changed()
    page.editor.refresh()
    assert page.document.errors() == []


@pytest.mark.nightly
def test_the_joints_of_a_motion_are_listed_and_assigned_in_a_table_beside_the_scene(page: Page) -> None:
    shutil.copy(STAND_INS["own_mixamo"].path(), page.path.parent / "walk.bvh")
    page.editor.select("person walker")
    page.type("motion.file", "walk.bvh")
    matching = page.editor.matching
    names = page.app.source.scene.actors["walker"].motion.motion.joint_names  # type: ignore[attr-defined]
    elbow = next(name for name in names if name.endswith("LeftForeArm"))
    text = matching._text.content
    assert "l_elbow" in text and "LeftForeArm" in text and "confidence" in text
    matching._role.value = "LeftElbow"
    matching._show_joint()
    assert matching._joint.value == elbow
    hand = next(name for name in names if name.endswith("LeftHand"))
    matching.assign("LeftElbow", hand)
    assert page.document.value("humans.walker.motion.joint_names") == "walk_joints.yaml"
    assert page.document.errors() == []
    match = page.app.source.scene.actors["walker"].motion.match  # type: ignore[attr-defined]
    assert names[match.roles["LeftElbow"]] == hand
    assert "humansim motion table walk.bvh" in page.document.command()
    page.editor.undo()
    assert not (page.path.parent / "walk_joints.yaml").exists()
    assert page.document.value("humans.walker.motion.joint_names") is None
    for role, joint in (("LeftElbow", "(none)"), ("Tail", hand), ("LeftElbow", "no such joint")):
        told = len(page.told)
        matching.assign(role, joint)
        assert len(page.told) == told + 1 and not (page.path.parent / "walk_joints.yaml").exists()


def test_cameras_of_a_calibration_are_described_and_chosen(page: Page) -> None:
    page.document.remove("cameras")
    (page.path.parent / "lab.yaml").write_text(DEMO)
    calibration = page.editor.calibration
    calibration.file.take("lab.yaml")
    assert "4 cameras, 4 with a pose" in calibration._facts.content
    assert list(calibration._boxes) == ["camera_1", "camera_2", "camera_3", "camera_4"]
    for name in ("camera_2", "camera_4"):
        calibration._boxes[name].value = False
    calibration._load()
    assert page.document.value("rig.cameras") == ["camera_1", "camera_3"]
    assert list(page.app.source.cameras) == ["camera_1", "camera_3"]
    for box in calibration._boxes.values():
        box.value = False
    with pytest.raises(HumansimError, match="choose a camera"):
        calibration._load()
    calibration.load("lab.yaml", only=["top"])
    assert "none of these cameras" in page.told[-1]
    (page.path.parent / "bad.json").write_text("{}")
    with pytest.raises(HumansimError, match=r"bad\.json"):
        calibration.file.take("bad.json")


def test_results_of_commands_are_links_to_files_of_the_folder_only(page: Page) -> None:
    commands = page.app.commands
    assert commands is not None
    folder = page.path.parent
    commands.choose("snapshot")
    assert commands._text.value == "humansim snapshot scene.yaml -o scene_snapshot.png"
    (folder / "secret.txt").write_text("secret")
    commands.start("humansim check scene.yaml")
    job = commands.job
    assert job is not None
    commands._outputs.append("out")
    (folder / "out").mkdir()
    (folder / "out" / "a b.csv").write_text("1")
    (folder / "out" / "link.txt").symlink_to(folder / "secret.txt")
    job.text = "humansim export scene.yaml -o out"
    job.close()
    assert "[a b.csv]" not in commands._links() and "results/out/a%20b.csv" in commands._links()
    assert "link.txt" not in commands._links()
    assert commands.result("out/a b.csv") == folder.resolve() / "out" / "a b.csv"
    for name in (
        "secret.txt",
        "out/link.txt",
        "../x",
        "/etc/passwd",
        "out",
        "scene.yaml",
        "out/../secret.txt",
        "a\0",
    ):
        assert commands.result(name) is None, name


@pytest.mark.parametrize(
    "line",
    [
        "humansim human fit views.yaml -o fit.yaml --detector 'touch x'",
        "humansim human fit views.yaml -o fit.yaml --detector=touch",
        "humansim view views.yaml --ros",
        "humansim human build person.yaml -o person.npz",
        "humansim challenge --tracker 'touch x' -o report",
    ],
)
def test_no_option_that_starts_other_programs_is_taken(line: str, unchanged_page: Page) -> None:
    assert "humansim" in refusal_of(unchanged_page, line)
