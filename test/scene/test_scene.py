"""Scene files: content and errors, without rendering."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import ROOT
from everything import everything
from hypothesis import given, settings
from hypothesis import strategies as st

from humansim_ros.errors import CameraError, HumansimError, MeshError, MotionError, SceneError
from humansim_ros.scene import Actor, Scene, SceneObject
from humansim_ros.scene.config.config import SceneConfig, load_config
from humansim_ros.scene.core.source import SceneSource

GOOD = """\
rate: 25
room: null
humans:
  anna:
    body: adult_man
    motion:
      file: walk
      loop: continue
cameras:
  left:
    size: [320, 240]
    position: [3, 0, 1.5]
    look_at: [0, 0, 1]
    fov_deg: 60
  right:
    size: [640, 480]
    K: [[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]]
    R: [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    t: [0, 1, 4]
"""
Write = Callable[[str], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def write_scene(text: str) -> Path:
        path = tmp_path / "scene.yaml"
        path.write_text(text)
        return path

    return write_scene


# Accepted content


def test_a_scene_has_the_humans_and_cameras_of_its_file(write: Write) -> None:
    scene = Scene.load(write(GOOD))
    assert list(scene.actors) == ["anna"]
    assert scene.actors["anna"].instance == 1
    assert list(scene.cameras) == ["left", "right"]
    assert scene.cameras["left"].size == (320, 240)
    np.testing.assert_allclose(scene.cameras["left"].center, [3, 0, 1.5], atol=1e-12)
    # x_cam = R x + t: the origin lies 4 m before the camera, 1 m below its axis
    pixels, depth = scene.cameras["right"].project(np.zeros((1, 3)))
    np.testing.assert_allclose(pixels, [[319.5, 239.5 + 500 / 4]])
    np.testing.assert_allclose(depth, [4])
    assert scene.static_meshes == []
    assert scene.period == 1 / 25


def test_humans_are_numbered_in_the_files_order(write: Write) -> None:
    two = GOOD.replace("humans:\n", "humans:\n  zoe: {}\n")
    assert {n: a.instance for n, a in Scene.load(write(two)).actors.items()} == {"zoe": 1, "anna": 2}


@pytest.mark.slow
def test_the_demo_scene_loads() -> None:
    scene = Scene.load()
    assert len(scene.cameras) == 4
    assert len(scene.actors) == 1
    assert len(scene.static_meshes) > 10


def test_a_human_of_the_demo_stands_on_the_floor_upright() -> None:
    scene = Scene.load()
    (actor,) = scene.actors.values()
    state = actor.at(0.3)
    assert state.vertices.shape == actor.human.mesh.vertices.shape
    assert abs(state.vertices[:, 2].min()) < 0.05
    assert 1.6 < np.ptp(state.vertices[:, 2]) < 1.85


def test_velocities_of_the_body_are_the_slope_of_its_joints() -> None:
    (actor,) = Scene.load().actors.values()
    for time in (0.105, 1.0, 2.3):
        span = np.linspace(-1e-3, 1e-3, 9)
        positions = np.array([actor.at(time + dt).positions.ravel() for dt in span])
        slope = np.polyfit(span, positions, 1)[0].reshape(-1, 3)
        state = actor.at(time)
        assert state.linear is not None
        # joint velocities are extrapolated for a millisecond: links change their lengths by micrometres
        np.testing.assert_allclose(state.linear, slope, atol=0.03)


def test_cameras_may_share_what_they_say_by_merge_keys(write: Write) -> None:
    text = """\
cameras:
  left: &all
    size: [320, 240]
    position: &here [3, 0, 1.5]
    look_at: [0, 0, 1]
    fov_deg: 50
  right:
    <<: *all
    look_at: *here
    up: [0, 1, 0]
    position: [3, 1, 1.5]
"""
    cameras = load_config(write(text)).cameras
    assert cameras["right"].size == (320, 240)
    assert cameras["right"].look_at == cameras["left"].position == (3, 0, 1.5)
    assert cameras["right"].position == (3, 1, 1.5)
    with pytest.raises(SceneError) as caught:
        load_config(write(text.replace("[3, 1, 1.5]", "[3, 1, up]")))
    assert (caught.value.line, caught.value.key) == (11, "cameras.right.position.2")


def test_files_are_looked_for_from_the_scenes_folder(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "data").mkdir()
    shutil.copy(ROOT / "assets" / "motions" / "walk.bvh", tmp_path / "data" / "mine.bvh")
    shutil.copy(ROOT / "assets" / "humans" / "adult_man.npz", tmp_path / "data" / "me.npz")
    shutil.copy(ROOT / "config" / "joint_names" / "biovision.yaml", tmp_path / "data" / "names.yaml")
    text = GOOD.replace("file: walk", "file: data/mine.bvh\n      joint_names: data/names.yaml")
    path = write(text.replace("adult_man", "data/me.npz"))
    monkeypatch.chdir("/")
    actor = Scene.load(path).actors["anna"]
    assert actor.human.name == "me"
    assert Path(actor.motion.motion.path) == tmp_path / "data" / "mine.bvh"


def test_a_camera_may_be_a_projection_matrix(write: Write) -> None:
    p = np.array([[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]]) @ np.array(
        [[1, 0, 0, 0], [0, 0, -1, 1], [0, 1, 0, 4]]
    )
    text = GOOD[: GOOD.index("    K:")] + f"    P: {(-2 * p).tolist()}\n"
    cameras = Scene.load(write(text)).cameras
    expected = Scene.load(write(GOOD)).cameras["right"]
    np.testing.assert_allclose(cameras["right"].K, expected.K, atol=1e-9)
    np.testing.assert_allclose(cameras["right"].t, expected.t, atol=1e-9)


@settings(deadline=None, max_examples=100)
@given(st.integers(0, 10**6))
def test_frame_times_are_exact_over_a_million_frames(index: int) -> None:
    for rate in (30, 25, 24, 60, 120, 7):
        config = SceneConfig.model_validate(
            {"rate": rate, "cameras": {"c": {"position": [1, 0, 1], "look_at": [0, 0, 1]}}}
        )
        scene = Scene(SceneSource(), config, {}, {})
        assert scene.frame_time(index) == round(Fraction(index * 10**9, rate))


def test_names_that_are_allowed_are_names_for_ros() -> None:
    validate = pytest.importorskip("rclpy.validate_full_topic_name").validate_full_topic_name
    for name in ("a", "A1_", "camera_1", "x__y"):
        assert load_names(name)
        assert validate(f"/{name}/image_raw")


def load_names(name: str) -> bool:
    config = {"cameras": {name: {"position": [1, 0, 1], "look_at": [0, 0, 1]}}}
    return list(SceneConfig.model_validate(config).cameras) == [name]


# Refused content

WRONG: list[tuple[str, str, int | None, str | None, str]] = [
    ("empty", "", None, None, "empty"),
    ("no mapping", "- a\n- b\n", None, None, "mapping"),
    ("one word", "walk", None, None, "mapping"),
    ("broken YAML", GOOD.replace("look_at: [0, 0, 1]", "look_at: [0, 0, 1"), 14, None, "not valid YAML"),
    ("a tab", GOOD.replace("    body", "\tbody"), 5, None, "not valid YAML"),
    ("an impossible date", GOOD.replace("rate: 25", "rate: 2001-99-99"), None, None, "not valid YAML"),
    ("brackets without end", "rate: " + "[" * 1_200, 1, None, "more than 50 nested levels"),
    ("a number without end", "rate: 1" + ":1" * 100_000, 1, None, "too long"),
    ("a number that is none", GOOD.replace("25", "!!int ''"), None, None, "not valid YAML"),
    ("a character that is none", GOOD.replace("walk", "wa\x07lk"), 7, None, "character 0x7 is not allowed"),
    ("a Python object", GOOD.replace("25", "!!python/object/apply:os.getcwd []"), 1, None, "not valid YAML"),
    (
        "unknown key",
        GOOD.replace("rate:", "fps:"),
        1,
        "fps",
        (
            "unknown key; did you mean `rate`? Known here: rate, renderer, room, humans, variety, crowd, "
            "objects, robot, rig"
        ),
    ),
    (
        "unknown key of a motion",
        GOOD.replace("loop:", "lop:"),
        8,
        "humans.anna.motion.lop",
        "unknown key; did you mean `loop`? Known here: file, joint_names, unit",
    ),
    (
        "unknown key of a camera",
        GOOD.replace("look_at:", "target:"),
        13,
        "cameras.left.target",
        "unknown key; did you mean `look_at`? Known here: size, calibration",
    ),
    (
        "unknown key of a human",
        GOOD.replace("body:", "mesh:"),
        5,
        "humans.anna.mesh",
        "did you mean `body`? Known here: body, outfit, skinning, motion",
    ),
    (
        "unknown key of the room",
        GOOD.replace("null", "{colour: red}"),
        2,
        "room.colour",
        "known here: size, seed",
    ),
    ("a word for a number", GOOD.replace("25", "fast"), 1, "rate", "number"),
    (
        "a rate of zero",
        GOOD.replace("25", "0"),
        1,
        "rate",
        "give a number above 0 and at most 1000 (frames per second); found 0",
    ),
    ("a rate that is not finite", GOOD.replace("25", ".inf"), 1, "rate", "found inf"),
    ("a rate beyond reason", GOOD.replace("25", "1e9"), 1, "rate", "1000"),
    (
        "a loop of no kind",
        GOOD.replace("continue", "forever"),
        8,
        "humans.anna.motion.loop",
        "none, repeat or continue",
    ),
    (
        "a position of two",
        GOOD.replace("[3, 0, 1.5]", "[3, 0]"),
        12,
        "cameras.left.position.2",
        "three numbers",
    ),
    (
        "a position of words",
        GOOD.replace("[3, 0, 1.5]", "[3, 0, up]"),
        12,
        "cameras.left.position.2",
        "number",
    ),
    ("NaN", GOOD.replace("[3, 0, 1.5]", "[3, 0, .nan]"), 12, "cameras.left.position.2", "found nan"),
    ("half a pixel", GOOD.replace("[320, 240]", "[320.5, 240]"), 11, "cameras.left.size.0", "whole numbers"),
    ("fov of 180", GOOD.replace("fov_deg: 60", "fov_deg: 180"), 14, "cameras.left.fov_deg", "below 180"),
    (
        "a camera given twice",
        GOOD.replace("    fov_deg: 60", "    P: " + str([[1.0] * 4] * 3)),
        10,
        "cameras.left",
        "one of them",
    ),
    ("half a camera", GOOD.replace("    t: [0, 1, 4]\n", ""), 15, "cameras.right", "give both"),
    ("fov with K", GOOD + "    fov_deg: 50\n", 15, "cameras.right", "fov_deg and by K"),
    ("a calibration with K", GOOD + "    calibration: a.yaml\n", 15, "cameras.right", "K and by calibration"),
    ("two places", GOOD + "    trajectory: a.txt\n", 15, "cameras.right", "R, t and by trajectory"),
    (
        "nowhere",
        GOOD.replace("    R: [[1, 0, 0], [0, 0, -1], [0, 1, 0]]\n    t: [0, 1, 4]\n", ""),
        15,
        "cameras.right",
        "the camera has no pose",
    ),
    ("a unit of nothing", GOOD + "    unit: 0.001\n", 15, "cameras.right", "go with a calibration"),
    (
        "a lens of no kind",
        GOOD + "    distortion_model: thick\n",
        20,
        "cameras.right.distortion_model",
        "plumb",
    ),
    (
        "a distorted P",
        GOOD[: GOOD.index("    K:")] + "    P: " + str([[1.0] * 4] * 3) + "\n    distortion: [1]\n",
        15,
        "cameras.right",
        "distortion goes with K",
    ),
    (
        "a sensor's wrong key",
        GOOD + "    sensor: {iso: 100}\n",
        20,
        "cameras.right.sensor.iso",
        "known here: enc",
    ),
    (
        "a noise's wrong key",
        GOOD + "    sensor: {noise: {iso: 100}}\n",
        20,
        "cameras.right.sensor.noise.iso",
        "known here: full_well",
    ),
    (
        "a rig's wrong key",
        "rig: {sensor: {iso: 100}, file: a}\n" + GOOD,
        1,
        "rig.sensor.iso",
        "here: encoding",
    ),
    ("no cameras", GOOD[: GOOD.index("cameras")], None, None, "at least one camera"),
    ("empty cameras", GOOD[: GOOD.index("cameras")] + "cameras: {}\n", None, None, "at least one camera"),
    ("a name with a dash", GOOD.replace("left:", "left-1:"), 10, "cameras.left-1", "letters, digits"),
    ("a name with a slash", GOOD.replace("anna:", "a/b:"), 4, "humans.a/b", "letters, digits"),
    (
        "a name that starts with a number",
        GOOD.replace("left:", "1left:"),
        10,
        "cameras.1left",
        "letters, digits",
    ),
    ("a number for a name", GOOD.replace("left:", "7:"), 10, "cameras.7", "found the name 7"),
    ("the same camera twice", GOOD.replace("right:", "left:"), 15, "left", "repeated key"),
    ("the same key twice", "rate: 30\n" + GOOD, 2, "rate", "repeated key"),
    ("an unknown renderer", "renderer: crayon\n" + GOOD, 1, "renderer", "give moderngl or pyrender"),
    ("a small room", GOOD.replace("null", "{size: [2, 2, 2]}"), 2, "room", "at least 5"),
    ("a room of a negative seed", GOOD.replace("null", "{seed: -1}"), 2, "room.seed", "of 0 or more"),
]


@pytest.mark.daily("name0")
@pytest.mark.parametrize("name", ["x" * 5000, "a\\0b", "~nobody_of_this_name/x"])
def test_names_that_no_file_can_have_are_refused(write: Write, name: str) -> None:
    quoted = f'"{name}"'
    for text in (
        GOOD.replace("adult_man", quoted),
        GOOD.replace("file: walk", f"file: {quoted}"),
        GOOD.replace("file: walk", f"joint_names: {quoted}"),
        GOOD.replace("room: null", f"room: null\nobjects: {{a: {{mesh: {quoted}}}}}"),
        GOOD.replace("room: null", f"room: null\nworld: {{meshes: [{quoted}], background: {quoted}}}"),
        GOOD.replace("position: [3, 0, 1.5]\n    look_at: [0, 0, 1]", f"trajectory: {quoted}"),
    ):
        with pytest.raises(HumansimError):
            Scene.load(write(text))


@pytest.mark.daily("unknown key of a motion", "a Python object")
@pytest.mark.parametrize(
    ("text", "line", "key", "message"), [w[1:] for w in WRONG], ids=[w[0] for w in WRONG]
)
def test_a_wrong_scene_is_refused_with_file_line_and_key(
    write: Write, text: str, line: int | None, key: str | None, message: str
) -> None:
    load_config(write(GOOD))
    path = write(text)
    with pytest.raises(SceneError) as caught:
        load_config(path)
    assert caught.value.path == str(path)
    assert caught.value.key == key
    assert caught.value.line == line
    assert message in caught.value.message


def test_a_missing_scene_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"nowhere\.yaml: no such scene file"):
        Scene.load(tmp_path / "nowhere.yaml")


@pytest.mark.parametrize(
    ("old", "new", "key", "built_in"),
    [
        ("file: walk", "file: wlak", "humans.anna.motion.file", "walk"),
        ("file: walk", "file: motions/run.bvh", "humans.anna.motion.file", "walk"),
        ("body: adult_man", "body: adult_mna", "humans.anna.body", "adult_man"),
        ("body: adult_man", "body: nobody.obj", "humans.anna.body", "adult_man"),
    ],
)
def test_a_file_that_is_not_there_is_named_with_its_key(
    write: Write, old: str, new: str, key: str, built_in: str
) -> None:
    path = write(GOOD.replace(old, new))
    with pytest.raises(SceneError) as caught:
        Scene.load(path)
    assert (caught.value.path, caught.value.key) == (str(path), key)
    assert new.split(": ")[1] in caught.value.message
    assert built_in in caught.value.message


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("motion_player", "is the node of the motion player"),
        ("skinner_anna", "is the node of the skinner of anna"),
    ],
)
def test_a_camera_with_the_name_of_another_node_is_refused(write: Write, name: str, message: str) -> None:
    path = write(GOOD.replace("  right:", f"  {name}:"))
    with pytest.raises(SceneError, match=message) as caught:
        Scene.load(path)
    line = 1 + path.read_text().splitlines().index(f"  {name}:")
    assert (caught.value.path, caught.value.key, caught.value.line) == (str(path), f"cameras.{name}", line)


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("[[500, 0, 319.5], [0, 500, 239.5]", "[[0, 0, 319.5], [0, 500, 239.5]", "cameras.right.K"),
        ("[[1, 0, 0], [0, 0, -1]", "[[1, 0, 0], [0, 0, 1]", "cameras.right.R"),
        ("size: [640, 480]", "size: [640, 0]", "cameras.right.size"),
        ("size: [640, 480]", "size: [640, 99999]", "cameras.right.size"),
        ("look_at: [0, 0, 1]", "look_at: [3, 0, 1.5]", "cameras.left.look_at"),
        ("look_at: [0, 0, 1]", "look_at: [3, 0, 0]", "cameras.left.up"),
        (
            "t: [0, 1, 4]",
            "t: [0, 1, 4]\n    distortion: [0, 0, 0, 0, 0, 0, 0, 0, 9]",
            "cameras.right.distortion",
        ),
        ("t: [0, 1, 4]", "t: [0, 1, 4]\n    roi: {x: 600, width: 60, height: 40}", "cameras.right.roi"),
        ("t: [0, 1, 4]", "t: [0, 1, 4]\n    binning: [2, 0]", "cameras.right.binning"),
    ],
)
def test_an_impossible_camera_is_named_with_its_part(write: Write, old: str, new: str, key: str) -> None:
    assert old in GOOD
    path = write(GOOD.replace(old, new))
    with pytest.raises(CameraError) as caught:
        Scene.load(path)
    assert (caught.value.path, caught.value.key) == (str(path), key)


def test_a_broken_motion_or_body_of_a_scene_is_named_itself(write: Write, tmp_path: Path) -> None:
    (tmp_path / "bad.bvh").write_text("HIERARCHY\nROOT")
    with pytest.raises(MotionError, match=r"bad\.bvh:2: "):
        Scene.load(write(GOOD.replace("file: walk", "file: bad.bvh")))
    (tmp_path / "bad.obj").write_text("v 0 0 0\nf 1 1")
    with pytest.raises(MeshError, match=r"bad\.obj:2: "):
        Scene.load(write(GOOD.replace("adult_man", "bad.obj")))
    with pytest.raises(MotionError, match="no joint table and no YAML file 'mine'"):
        Scene.load(write(GOOD.replace("file: walk", "joint_names: mine")))


@pytest.mark.nightly
@settings(deadline=None, max_examples=60)
@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(max_size=5) | st.integers(),
        lambda inner: (
            st.lists(inner, max_size=3)
            | st.dictionaries(
                st.sampled_from(
                    ["humans", "cameras", "objects", "keyframes", "room", "rate", "size", "K", "a", "motion"]
                ),
                inner,
                max_size=4,
            )
        ),
        max_leaves=12,
    )
)
def test_any_tree_gives_a_scene_or_a_scene_error(
    tmp_path_factory: pytest.TempPathFactory, tree: object
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_text(yaml.safe_dump(tree))
    try:
        config = load_config(path)
    except HumansimError as error:
        assert isinstance(error, SceneError)  # noqa: PT017
    else:
        assert config.cameras


def test_people_of_one_file_share_its_body_and_motion(tmp_path: Path) -> None:
    body = shutil.copy(ROOT / "assets" / "humans" / "adult_man.npz", tmp_path)
    person = {"body": str(body), "motion": {"file": "walk", "position": [0, 0]}}
    beside = {**person, "motion": {"file": "walk", "position": [1, 0]}}
    other = {**person, "outfit": "green"}
    data = {"humans": {"a": person, "b": beside, "c": other}, "cameras": yaml.safe_load(GOOD)["cameras"]}
    first, second, third = Scene.from_dict(data).actors.values()
    assert second.human is first.human
    assert second.motion.motion is first.motion.motion
    assert third.human.outfit == "green" and third.human.skeleton is first.human.skeleton
    assert Scene.from_dict(data).actors["a"].human is not first.human  # a changed file is read again


SCENES = [*sorted((ROOT / "config" / "scenes").glob("*.yaml")), None]


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem if path else "everything")
def test_each_human_and_each_object_is_built_once(
    path: Path | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also in scenes with random people, who keep away from the humans and objects of the file."""
    built: dict[str, Counter[str]] = {"Actor": Counter(), "SceneObject": Counter()}

    def counting(build: Callable[..., Any]) -> Any:
        def counted(kind: type, name: str, *args: Any, **keys: Any) -> Any:
            built[kind.__name__][name] += 1
            return build(name, *args, **keys)

        return classmethod(counted)

    monkeypatch.setattr(Actor, "build", counting(Actor.build))
    monkeypatch.setattr(SceneObject, "build", counting(SceneObject.build))
    scene = Scene.from_dict(everything(tmp_path)) if path is None else Scene.load(path)
    del built["Actor"][""]  # motions that random people try
    assert built == {"Actor": Counter(scene.actors.keys()), "SceneObject": Counter(scene.objects.keys())}
