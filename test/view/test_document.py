"""The scene file that the page edits: values, placing, undo, errors by line, saving; bad input."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import ROOT
from scipy.spatial.transform import Rotation

from humansim_ros.errors import HumansimError, SceneError
from humansim_ros.motion.body.skeleton import body_joints
from humansim_ros.scene import Scene
from humansim_ros.view.edit.document import NEW_SCENE, SceneDocument

SCENES = sorted((ROOT / "config/scenes").glob("*.yaml"))
ROOMLESS = "room: null\ncameras:\n  c: {position: [3, 0, 1.5], look_at: [0, 0, 1]}  # in front\n"


def document(text: str = ROOMLESS, folder: Path | None = None) -> SceneDocument:
    return SceneDocument(text, folder=folder)


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_a_scene_that_is_opened_and_saved_has_the_same_bytes(path: Path, tmp_path: Path) -> None:
    shutil.copytree(path.parent, tmp_path / "s")
    opened = SceneDocument.load(tmp_path / "s" / path.name)
    assert not opened.changed
    opened.set("rate", 25)
    assert opened.changed
    opened.undo()
    opened.save()
    assert (tmp_path / "s" / path.name).read_bytes() == path.read_bytes()


@pytest.mark.daily("demo")
@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_placing_everything_changes_one_line_for_each_key(path: Path) -> None:
    opened = SceneDocument.load(path)
    before = path.read_text().splitlines()
    for kind in ("humans", "objects", "cameras"):
        for name in opened.names(kind):
            opened.place(kind, name, np.add(opened.pose(kind, name).position, [0.1, 0.2, 0]))
    after = opened.text().splitlines()
    assert [line for line in before if line.strip().startswith("#")] == [
        line for line in after if line.strip().startswith("#")
    ]
    kept = [line for line in before if "position" not in line and "keyframes" not in line]
    assert [line for line in kept if line not in after] == []
    assert opened.errors() == []


def test_edits_give_the_scene_that_run_loads(tmp_path: Path) -> None:
    opened = document(NEW_SCENE)
    name = opened.add_person("anna", near=(1, 1), body="child", motion="wave")
    opened.place("humans", name, (0.5, 1.25), yaw_deg=90)
    opened.add_object("crate", near=(-1, -1))
    opened.add_camera("side", near=(0, 3, 2))
    saved = opened.save(tmp_path / "scene.yaml")
    scene = Scene.load(saved)
    assert list(scene.actors) == ["person", "anna"] and list(scene.cameras) == ["camera_1", "side"]
    placed = scene.config.humans["anna"].motion
    assert placed.position == (0.5, 1.25) and placed.yaw_deg == 90
    np.testing.assert_allclose(scene.cameras["side"].center, [0, 3, 2], atol=1e-9)
    assert list(opened.scene().actors) == list(scene.actors)
    assert not opened.changed


def test_short_forms_become_sections_when_a_key_of_them_is_set() -> None:
    opened = document(ROOMLESS + "humans:\n  anna: adult_woman  # who\n")
    opened.set("humans.anna.motion.speed", 2)
    assert opened.text().endswith("  anna: {body: adult_woman, motion: {speed: 2}} # who\n")
    opened.set("humans.anna.motion", "wave")
    opened.set("humans.anna.motion.yaw_deg", 45)
    assert opened.value("humans.anna.motion") == {"file": "wave", "yaw_deg": 45}
    assert opened.value("humans.anna.motion.file") == "wave"
    assert opened.value("humans.anna.outfit") is None
    assert opened.value("light.strength") == 1.0 and opened.value("rate") == 30.0
    opened.set("world.meshes.0.file", "room.obj")
    assert opened.text().endswith("\nworld: {meshes: [{file: room.obj}]}\n")
    opened.undo()
    assert opened.errors() == []


def test_new_names_are_free_and_people_do_not_stand_in_each_other() -> None:
    opened = document()
    names = [opened.add_person("anna") for _ in range(3)] + [
        opened.add_object("anna"),
        opened.add_camera("c"),
    ]
    assert names == ["anna", "anna_2", "anna_3", "anna_4", "c_2"]
    places = [opened.pose("humans", name).position for name in names[:3]]
    distances = [np.linalg.norm(a - b) for n, a in enumerate(places) for b in places[:n]]
    assert min(distances) >= 0.8
    copied = opened.duplicate("humans", "anna")
    assert copied == "anna_5"
    opened.rename("humans", "anna", "berta")
    assert opened.names("humans") == ["berta", "anna_2", "anna_3", "anna_5"]
    with pytest.raises(SceneError, match="the name 'c' is taken"):
        opened.rename("humans", "berta", "c")
    opened.remove("humans.berta")
    assert "berta" not in opened.text()


CAMERAS = """\
room: null
cameras:
  target: {position: [3, 1, 1.5], look_at: [0, 0, 1]}
  rolled: {position: [3, 1, 1.5], look_at: [0, 0, 1], up: [0, 0.5, 1]}
  matrix:
    R: [[0, 1, 0], [0, 0, -1], [-1, 0, 0]]  # optical axis to -x
    t: [0, 1, 3]
  projection: {P: [[0, 600, 0, 0], [0, 0, -600, 600], [-1, 0, 0, 3]]}
"""


@pytest.mark.parametrize("name", ["target", "rolled", "matrix", "projection"])
@pytest.mark.parametrize("vertical", [False, True])
def test_a_camera_stands_where_it_is_placed_in_every_form(name: str, vertical: bool) -> None:
    opened = document(CAMERAS)
    form = set(yaml.safe_load(CAMERAS)["cameras"][name])
    # optical frame: z forward, y down; then turned by roll, pitch and yaw
    ahead = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0.0]])
    turn = Rotation.from_euler("xyz", [0 if vertical else 10, 90 if vertical else 20, 30], degrees=True)
    quaternion = (turn * Rotation.from_matrix(ahead)).as_quat()
    opened.place("cameras", name, (2.123456, -1, 2.5), quaternion=quaternion)
    camera = opened.scene().cameras[name]
    np.testing.assert_allclose(camera.center, [2.1235, -1, 2.5], atol=2e-4)
    error = Rotation.from_matrix(camera.R.T) * Rotation.from_quat(quaternion).inv()
    assert np.degrees(error.magnitude()) < 0.02
    assert set(yaml.safe_load(opened.text())["cameras"][name]) - {"up"} == form - {"up"}


def test_a_camera_that_is_moved_still_looks_at_its_target_and_yaw_turns_it() -> None:
    opened = document(CAMERAS)
    opened.place("cameras", "target", (2, 2, 2))
    assert opened.value("cameras.target.look_at") == [0, 0, 1]
    opened.place("cameras", "target", yaw_deg=0)
    ahead = opened.scene().cameras["target"].R[2]
    assert ahead[0] > 0.5 and abs(ahead[1]) < 1e-3
    assert "up" not in opened.value("cameras.target")


def test_cameras_of_calibration_files_are_overridden_rigs_are_moved_whole(tmp_path: Path) -> None:
    source = document(CAMERAS).save(tmp_path / "cams.yaml")
    opened = SceneDocument(
        "room: null\nrig: cams.yaml\ncameras:\n  own: {calibration: cams.yaml, camera: matrix}  # mine\n",
        folder=tmp_path,
    )
    opened.place("cameras", "own", (1, 2, 3))
    assert "# mine" in opened.text()
    scene = opened.scene()
    np.testing.assert_allclose(scene.cameras["own"].center, [1, 2, 3], atol=1e-3)
    np.testing.assert_allclose(scene.cameras["own"].R, Scene.load(source).cameras["matrix"].R, atol=1e-3)
    with pytest.raises(SceneError, match="this is a camera of the rig: place the rig"):
        opened.place("cameras", "target", (0, 0, 1))
    opened.place("rig", "rig", (0, 0, 0.5), yaw_deg=90)
    np.testing.assert_allclose(opened.scene().cameras["target"].center, [-1, 3, 2], atol=1e-9)
    np.testing.assert_allclose(opened.pose("rig", "rig").position, [0, 0, 0.5], atol=1e-9)


def test_a_camera_on_a_trajectory_cannot_be_placed(tmp_path: Path) -> None:
    (tmp_path / "way.txt").write_text("0 0 0 1 0 0 0 1\n1 1 0 1 0 0 0 1\n")
    opened = document("room: null\ncameras:\n  dolly: {trajectory: way.txt}\n", tmp_path)
    with pytest.raises(SceneError, match=r"cameras\.dolly: its trajectory moves this camera"):
        opened.place("cameras", "dolly", (1, 1, 1))


@pytest.mark.parametrize("seconds", [0.0, 2.0])
def test_what_keyframes_move_is_placed_where_it_is_at_that_time(seconds: float) -> None:
    opened = SceneDocument.load(ROOT / "config/scenes/moving_objects.yaml")
    turned = Rotation.from_euler("z", 40, degrees=True).as_quat()
    opened.place("objects", "platform", (1, 0.5, 0.3), quaternion=turned, seconds=seconds)
    pose = opened.scene().objects["platform"].at(seconds)
    np.testing.assert_allclose(pose.position, [1, 0.5, 0.3], atol=2e-4)
    assert (Rotation.from_quat(pose.rotation) * Rotation.from_quat(turned).inv()).magnitude() < 1e-3
    opened.place("humans", "rider", (0.5, 0.5), seconds=seconds)
    np.testing.assert_allclose(opened.pose("humans", "rider", seconds).position[:2], [0.5, 0.5], atol=2e-4)


@pytest.mark.nightly
def test_steps_are_undone_and_redone_and_labelled() -> None:
    opened = document()
    texts = [opened.text()]
    opened.add_person("anna")
    texts.append(opened.text())
    for angle in (10, 20, 30):
        opened.set("humans.anna.motion.yaw_deg", angle, continues=True)
    texts.append(opened.text())
    assert opened.steps() == (["Add anna", "Set humans.anna.motion.yaw_deg"], [])
    assert opened.undo() == "Set humans.anna.motion.yaw_deg" and opened.text() == texts[1]
    assert opened.undo() == "Add anna" and opened.text() == texts[0]
    assert opened.undo() is None
    assert opened.redo() == "Add anna" and opened.text() == texts[1]
    opened.set("rate", 10)
    assert opened.redo() is None

    def fail() -> None:
        with opened.step("Fail"):
            opened.set("rate", 20)
            opened.set("rate", math.nan)

    with pytest.raises(SceneError):
        fail()
    assert opened.value("rate") == 10
    for rate in range(1, 205):
        opened.set("rate", rate)
    assert len(opened.steps()[0]) == 200


def test_errors_have_the_line_of_the_text_that_is_not_saved(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(ROOMLESS)
    opened = SceneDocument.load(path)
    opened.set("light.strength", -1)
    opened.set("rate", "fast")
    opened.add_person("anna", motion="no_such_motion")
    assert [(fault.key, fault.line) for fault in opened.errors()] == [("rate", 5), ("light.strength", 4)]
    opened.set("light.strength", 1)
    opened.set("rate", 30)
    ((key, line, message),) = opened.errors()
    assert (key, line) == ("humans.anna.motion.file", 7) and "no_such_motion" in message
    with pytest.raises(SceneError, match=r"scene\.yaml:7: humans\.anna\.motion\.file"):
        opened.scene()
    assert path.read_text() == ROOMLESS
    opened.set("humans.anna.motion.file", "wave")
    assert opened.errors() == []


@pytest.mark.parametrize(
    ("text", "line"),
    [("a: [", 1), ("rate: 30\nrate: 20\n", 2), ("", 1), ("- 1\n", 1), ("a: *b\n", 1), ("humans: {\x01}", 1)],
)
def test_texts_that_are_no_scenes_are_told_and_can_be_mended(tmp_path: Path, text: str, line: int) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(text or "# nothing\n")
    opened = SceneDocument.load(path)
    ((_, found, message),) = opened.errors()
    assert found == line and message
    with pytest.raises(SceneError):
        opened.scene()
    path.write_text(ROOMLESS)
    assert opened.changed_on_disk()
    opened.reload()
    assert opened.errors() == [] and not opened.changed_on_disk()


def test_a_file_that_others_changed_is_not_overwritten_unless_told(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + ROOMLESS.replace("\n", "\r\n").encode())
    opened = SceneDocument.load(path)
    opened.set("rate", 12)
    path.write_text("# theirs\n" + ROOMLESS)
    with pytest.raises(SceneError, match="another program has changed this file"):
        opened.save()
    assert path.read_text().startswith("# theirs")
    opened.save(overwrite=True)
    assert path.read_bytes() == b"\xef\xbb\xbf" + (ROOMLESS + "rate: 12\n").replace("\n", "\r\n").encode()
    (tmp_path / "other.yaml").write_text("mine")
    with pytest.raises(SceneError, match="this file exists"):
        opened.save(tmp_path / "other.yaml")
    for wrong in (tmp_path / "no" / "folder.yaml", tmp_path / "scene.txt"):
        with pytest.raises(HumansimError):
            opened.save(wrong)
    with pytest.raises(SceneError, match="a new scene has no file"):
        document().save()


def test_a_scene_saved_elsewhere_keeps_its_files(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "config/scenes", tmp_path / "a")
    (tmp_path / "b").mkdir()
    opened = SceneDocument.load(tmp_path / "a" / "moving_objects.yaml")
    opened.save(tmp_path / "b" / "copy.yaml")
    keyframes = "../a/moving_objects.xml"
    assert f"keyframes: {keyframes}\n" in (tmp_path / "b" / "copy.yaml").read_text()
    assert f"{{file: {keyframes}, object: on_platform}}" in (tmp_path / "b" / "copy.yaml").read_text()
    assert list(Scene.load(tmp_path / "b" / "copy.yaml").actors) == ["rider", "small_walker"]
    assert opened.value("humans.rider.motion.file") == "walk"


def test_the_command_of_a_step_is_the_lines_that_it_wrote(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(ROOMLESS)
    opened = SceneDocument.load(path)
    assert opened.command() == f"humansim run {path}"
    opened.add_person("anna")
    assert opened.command() == "\n".join(opened.text().splitlines()[-2:])
    opened.remove("humans")
    assert opened.command().startswith("# removed: humans:")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("rte", 1, "did you mean `rate`"),
        ("humans.anna.height", 1, "unknown key"),
        ("rate.x", 1, "no keys"),
        ("rate", math.nan, "give a number; found nan"),
        ("rate", math.inf, "give a number"),
        ("rate", object(), "cannot hold"),
        ("rate", 10**400, "too large"),
        ("cameras.c.position", [1, math.nan, 2], "give a number"),
        ("humans.a b.body", "child", "a name of letters, digits and _"),
        ("humans.ä.body", "child", "a name of letters"),
        (["humans", "x\n  y: 1", "body"], "child", "a name of letters"),
        (["humans", "n" * 10**6, "body"], "child", "at most 100 characters"),
        (["humans", 7, "body"], "child", "must be a text"),
        ("humans.anna.body", "b" * 10**6, "at most 10000 characters"),
        ("", 1, "not a key"),
        (".".join("a" * 10**5), 1, "not a key"),
        ("world.meshes.7.file", "x", "the list has 0 items"),
    ],
)
def test_hostile_keys_and_values_are_refused_and_change_nothing(
    key: str, value: object, message: str
) -> None:
    opened = document()
    with pytest.raises(SceneError, match=message):
        opened.set(key, value)
    assert opened.text() == ROOMLESS and opened.steps() == ([], [])


def test_hostile_places_and_names_are_refused() -> None:
    opened = document()
    for bad in ((math.nan, 0, 0), (1,), "here", (1e9, 0, 0), None):
        with pytest.raises(SceneError):
            opened.place("cameras", "c", bad, quaternion=(0, 0, 0, 0))
    for name in ("no", "", "a/b", "n" * 10**6):
        with pytest.raises(SceneError):
            opened.place("humans", name, (0, 0))
        with pytest.raises(SceneError):
            opened.remove(["humans", name])
    for name in ("", "1a", "a-b", "../x", "n" * 10**6, "\ud800"):
        with pytest.raises(SceneError):
            opened.add_person(name)
    with pytest.raises(SceneError):
        opened.rename("cameras", "c", "two words")
    assert opened.text() == ROOMLESS
    opened.set("humans.anna.body", "odd: {name}, 'quoted' # no comment\n\x7f\u2028")
    assert opened.value("humans.anna.body") == "odd: {name}, 'quoted' # no comment\n\x7f\u2028"
    assert opened.errors()


@pytest.mark.nightly
def test_a_text_stays_within_the_limit_of_scene_files() -> None:
    opened = document("# " + "x" * (1 << 20) + "\n" + ROOMLESS)
    with pytest.raises(SceneError, match="a scene file has at most 1048576 bytes"):
        opened.set("rate", 10)


@pytest.mark.daily("room")
@pytest.mark.parametrize("text", [ROOMLESS, NEW_SCENE], ids=["no room", "room"])
def test_new_cameras_see_the_people_from_directions_of_their_own(text: str) -> None:
    opened = document(text)
    opened.add_person("anna", near=(0.5, 0.5), motion="wave")
    for _ in range(3):
        opened.add_camera()
    scene = opened.scene()
    joints = np.concatenate(
        [
            actor.at(0.0).positions[body_joints(actor.human.skeleton.joint_names)]
            for actor in scene.actors.values()
        ]
    )
    for name in list(scene.cameras)[-3:]:
        camera = scene.cameras[name]
        across, down, depth = camera.K @ (camera.R @ joints.T + camera.t[:, None])
        pixels = np.stack([across, down]) / depth
        assert (depth > 0).all()
        inside = ((pixels > 0) & (pixels < np.array([[640], [480]]))).all(axis=0)
        assert inside.mean() > 0.8, name
        if scene.config.room is not None:
            assert (np.abs(camera.center[:2]) < np.array(scene.config.room.size[:2]) / 2).all()
    axes = np.array([camera.R[2] for camera in scene.cameras.values()])
    angles = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))[np.triu_indices(len(axes), 1)]
    assert angles.min() > 35


#: Walls beside the person, and the furniture of two rooms.
HIDING = {
    "wall": "room: null\nobjects:\n  wall: {mesh: box, size: [0.2, 5, 2.6], position: [1.6, 0, 1.3]}\n",
    "corner": "room: null\nobjects:\n  wall: {mesh: box, size: [0.2, 5, 2.6], position: [1.4, 0, 1.3]}\n"
    "  other: {mesh: box, size: [5, 0.2, 2.6], position: [0, -1.4, 1.3]}\n",
    "room 1": "room: {seed: 1}\n",
    "room 4": "room: {seed: 4, size: [5.2, 5.2, 2.6]}\n",
}


@pytest.mark.slow
@pytest.mark.daily("wall")
@pytest.mark.parametrize("hiding", HIDING)
def test_new_cameras_are_where_no_furniture_or_wall_hides_the_people(hiding: str) -> None:
    from humansim_ros import Simulation

    opened = document(HIDING[hiding] + "cameras: {}\n")
    opened.add_person("anna", near=(0.4, 0.3), motion="wave")
    for _ in range(4):
        opened.add_camera()
    pixels = []
    for text in (opened.text(), "room: null\n" + opened.text().split("\n", 1)[1]):
        scene = document(text)
        if pixels:
            for name in scene.names("objects"):
                scene.remove(["objects", name])
        assert scene.errors() == []
        with Simulation(scene.scene(), channels=("instance",)) as simulation:
            views = simulation.frame(0).views
        pixels.append({name: int((view.instance == 1).sum()) for name, view in views.items()})
    for name, alone in pixels[1].items():
        assert pixels[0][name] > 0.85 * alone > 1000, name
    centers = [camera.center for camera in opened.scene().cameras.values()]
    assert np.linalg.norm(np.subtract(centers, (0.4, 0.3, 0.9)), axis=1).max() < 6
