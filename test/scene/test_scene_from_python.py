"""Scenes made in Python, without a scene file."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from conftest import ROOT
from render_scenes import renderer_or_skip

from humansim_ros import load_human, read_motion
from humansim_ros.cameras import Camera
from humansim_ros.errors import HumansimError, MotionError, SceneError
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.scene import Scene, Simulation

SCENE: dict[str, Any] = {
    "rate": 25,
    "room": None,
    "humans": {"anna": {"body": "adult_woman", "motion": {"file": "wave", "yaw_deg": 30}}},
    "objects": {"ball": {"mesh": "sphere", "position": [1, 0, 0.5]}},
    "cameras": {"left": {"size": [64, 48], "position": [4, 0, 1.5], "look_at": [0, 0, 1]}},
}
WAVE = ROOT / "assets" / "motions" / "wave.bvh"
WOMAN = ROOT / "assets" / "humans" / "adult_woman.npz"
K = np.array([[50.0, 0, 31], [0, 52, 22], [0, 0, 1]])
BALL = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2, -1]], np.int32))


def assert_same(one: Scene, other: Scene) -> None:
    """Same humans at one time, same cameras, objects and rate."""
    assert (one.labels, one.period, one.environment.meshes) == (other.labels, other.period, ())
    for name, actor in one.actors.items():
        np.testing.assert_array_equal(actor.at(0.7).vertices, other.actors[name].at(0.7).vertices)
    for name, camera in one.cameras.items():
        assert camera.size == other.cameras[name].size
        np.testing.assert_array_equal(camera.P, other.cameras[name].P)
    assert list(one.objects) == list(other.objects)


def test_a_mapping_gives_the_scene_of_a_file_with_these_keys(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(yaml.safe_dump(SCENE))
    scene = Scene.from_dict(SCENE)
    assert_same(scene, Scene.load(path))
    assert scene.path is None
    assert repr(scene) == "Scene(humans=['anna'], objects=['ball'], cameras=['left'], rate=25)"


def test_names_stand_for_sections_with_a_file() -> None:
    short = SCENE | {
        "humans": {"anna": {"motion": "wave"}, "tom": "adult_man"},
        "objects": {"ball": "sphere"},
    }
    long = SCENE | {
        "humans": {"anna": {"motion": {"file": "wave"}}, "tom": {"body": "adult_man"}},
        "objects": {"ball": {"mesh": "sphere"}},
    }
    assert_same(Scene.from_dict(short), Scene.from_dict(long))


def test_relative_files_start_from_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copy(WAVE, tmp_path / "mine.bvh")
    scene = SCENE | {"humans": {"anna": {"motion": "mine.bvh"}}}
    assert list(Scene.from_dict(scene, tmp_path).actors) == ["anna"]
    monkeypatch.chdir(tmp_path)
    assert list(Scene.from_dict(scene).actors) == ["anna"]


def test_objects_in_memory_replace_file_names() -> None:
    camera = Camera.look_at((4, 0, 1.5), (0, 0, 1), size=(64, 48))
    woman, wave = load_human(WOMAN), read_motion(WAVE)
    built = Scene.build(
        humans={"anna": {"body": woman, "motion": {"file": wave, "yaw_deg": 30}}, "eva": woman},
        objects={"ball": BALL},
        cameras={"left": camera},
        rate=25,
        room=None,
    )
    assert built.actors["anna"].human is built.actors["eva"].human is woman
    assert built.actors["anna"].motion.motion is wave
    np.testing.assert_array_equal(built.objects["ball"].mesh.vertices, BALL.vertices)
    humans = {**SCENE["humans"], "eva": {"body": "adult_woman"}}
    assert_same(built, Scene.from_dict(SCENE | {"humans": humans}))


@pytest.mark.parametrize(
    "camera",
    [
        Camera((64, 48), np.array([[50, 1e-3, 31], [0, 52, 22], [0, 0, 1.0]]), np.eye(3), np.ones(3)),
        Camera.look_at((1, 2, 3), (0, 0, 1), size=(32, 24)),
        Camera(
            (64, 48),
            K,
            np.eye(3),
            np.zeros(3),
            (0.1, 0.01, 0, 0),
            "equidistant",
        ),
        Camera(
            (64, 48),
            K,
            np.eye(3),
            np.zeros(3),
            (-0.1, 0.01, 0.001, 0.002),
            rectification=np.eye(3),
            rectified=np.array([[48.0, 0, 30, -5], [0, 48, 23, 0], [0, 0, 1, 0]]),
        ),
    ],
    ids=["skew", "ideal", "fisheye", "stereo"],
)
def test_a_camera_in_memory_is_itself(camera: Camera) -> None:
    scene = Scene.build(cameras={"c": camera, "d": {"calibration": camera, "binning": [2, 2]}}, room=None)
    built = scene.cameras["c"]
    for name in ("size", "distortion", "model"):
        assert getattr(built, name) == getattr(camera, name)
    for name in ("K", "R", "t", "rectification", "rectified"):
        np.testing.assert_array_equal(getattr(built, name), getattr(camera, name))
    assert scene.cameras["d"].size == (camera.size[0] // 2, camera.size[1] // 2)


def test_a_camera_in_memory_may_get_another_pose() -> None:
    camera = Camera.look_at((1, 2, 3), (0, 0, 1), size=(32, 24), fov=1.0)
    keys = {"calibration": camera, "position": [4, 0, 1], "look_at": [0, 0, 1]}
    built = Scene.build(cameras={"c": keys}, room=None).cameras["c"]
    np.testing.assert_array_equal(built.K, camera.K)
    np.testing.assert_allclose(built.center, [4, 0, 1])


@pytest.mark.parametrize(
    ("change", "key", "message"),
    [
        ({"rat": 3}, "rat", "unknown key; did you mean `rate`? Known here: rate"),
        ({"rate": "fast"}, "rate", "give a number"),
        (
            {"humans": {"anna": {"motion": "wlak"}}},
            "humans.anna.motion.file",
            "no built-in motion and no file 'wlak'; did you mean 'walk'?",
        ),
        ({"humans": {"anna": {"body": BALL}}}, "humans.anna.body", "must be a Human, not a Mesh"),
        ({"humans": {"anna": BALL}}, "humans.anna.body", "must be a Human, not a Mesh"),
        ({"humans": {"a b": {}}}, "humans.a b", "give a name of letters, digits and _"),
        ({"humans": {"a" * 101: {}}}, f"humans.{'a' * 101}", "at most 100 characters; found the name"),
        ({"cameras": {}}, None, "at least one camera"),
        (
            {"cameras": {"c": {"position": [1, 1, 1], "look_at": [1, 1, 1]}}},
            "cameras.c.look_at",
            "same point",
        ),
        ({"world": {"meshes": ["gone.obj"]}}, "world.meshes.0.file", "no such file"),
    ],
)
def test_an_error_names_the_key(change: dict[str, Any], key: str | None, message: str) -> None:
    with pytest.raises(HumansimError) as caught:
        Scene.from_dict(SCENE | change)
    error = caught.value
    assert (error.path, error.line, error.key) == (None, None, key)
    assert message in error.message
    assert str(error).startswith(f"{key}: " if key else "a scene needs")


def test_an_error_in_a_file_names_key_and_file(tmp_path: Path) -> None:
    (tmp_path / "bad.bvh").write_text("HIERARCHY\nROOT")
    with pytest.raises(MotionError, match=rf"^humans\.anna\.motion\.file: {tmp_path}/bad\.bvh:2: "):
        Scene.from_dict(SCENE | {"humans": {"anna": {"motion": "bad.bvh"}}}, tmp_path)


def test_a_list_is_no_scene() -> None:
    with pytest.raises(SceneError, match="a scene is a mapping"):
        Scene.from_dict([1, 2])  # type: ignore[arg-type]


def test_a_scene_without_a_file_is_simulated() -> None:
    scene = Scene.from_dict(SCENE)
    renderer = renderer_or_skip(scene.static_meshes)
    with Simulation(scene, channels=("depth", "instance"), renderer=renderer) as simulation:
        assert simulation.channels == ("depth", "instance")
        frames = list(simulation.frames(2))
        simulation.playback.change("anna", file="walk")
        assert not np.array_equal(
            simulation.frame(5).humans["anna"].vertices, frames[0].humans["anna"].vertices
        )
    assert [repr(frame) for frame in frames] == [
        "Frame(index=0, stamp=1, humans=['anna'], views=['left'])",
        "Frame(index=1, stamp=40000001, humans=['anna'], views=['left'])",
    ]
    assert repr(frames[0].views["left"]) == "View(64x48: depth, instance)"
    assert 1 in frames[0].views["left"].instance


def test_a_motion_in_memory_can_be_changed_for_another() -> None:
    camera = Camera.look_at((4, 0, 1.5), (0, 0, 1), size=(64, 48))
    wave = read_motion(WAVE)
    scene = Scene.build(humans={"anna": {"motion": wave}}, cameras={"c": camera}, room=None)
    simulation = Simulation(scene, renderer=renderer_or_skip(scene.static_meshes))
    simulation.playback.change("anna", speed=0.5, mirror=True)
    assert simulation.playback.actors["anna"].motion.motion is wave
    simulation.playback.change("anna", file="walk")
    simulation.playback.change("anna", file=scene.config.humans["anna"].motion.file)
    assert simulation.playback.actors["anna"].motion.motion is wave
    with pytest.raises(
        SceneError, match=r"^humans\.anna\.motion\.file: no built-in motion and no file 'gone'"
    ):
        simulation.playback.change("anna", file="gone")
    simulation.close()
