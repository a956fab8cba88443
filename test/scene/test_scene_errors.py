"""Errors of scene files name the file, the line and the key; errors of other files name both files."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import annotated_types
import numpy as np
import pytest
import yaml
from conftest import ROOT
from pydantic import AfterValidator, BaseModel

from humansim_ros.cameras import Camera, write_calibration
from humansim_ros.errors import HumansimError
from humansim_ros.files.reading.images import encode_image
from humansim_ros.people.makehuman import PeopleConfig
from humansim_ros.ros.processes.node_processes import scene_processes
from humansim_ros.scene import Scene, SceneConfig
from humansim_ros.scene.config.config import load_config, map_files
from humansim_ros.scene.features.held import HoldConfig
from humansim_ros.scene.features.robot import PathConfig

#: A scene with all sections and all keys that name files.
SCENE: dict[str, Any] = {
    "room": {"seed": 2},
    "humans": {
        "anna": {
            "body": "adult_man",
            "motion": {"file": "walk", "joint_names": "table.yaml", "hands": [{"pose": "fist"}]},
            "keyframes": {"file": "keys.xml"},
            "face": {"file": "take.csv", "keys": [{"gaze": "left"}]},
            "reach": [{"to": [0.4, -0.2, 1.0]}],
        }
    },
    "variety": {"count": 1, "bodies": ["adult_man"], "motions": ["walk"]},
    "crowd": {
        "count": 1,
        "bodies": ["adult_man"],
        "motions": ["walk_straight"],
        "flows": [{"start": [-2, -1, -1, 1], "goal": [1, -1, 2, 1]}],
        "queues": [{"position": [1.5, 0], "count": 1}],
    },
    "objects": {"ball": {"mesh": "ball.obj", "keyframes": {"file": "keys.xml"}}},
    "rig": {"file": "rig.json", "background": {"a": "photo.png"}, "depth_sensor": {"preset": "kinect_v2"}},
    "cameras": {
        "left": {
            "calibration": "rig.json",
            "camera": "b",
            "background": "photo.png",
            "roi": {"width": 8, "height": 8},
            "sensor": {
                "noise": {"full_well": 5000},
                "vignetting": {"cos4": True},
                "chromatic_aberration": {"red": 0.1},
            },
            "faults": {
                "drop": {"probability": 0.1},
                "freeze": {"probability": 0.1},
                "outage": {"at": [[5, 8]]},
                "late": {"delay": [0.02, 0.1]},
                "out_of_order": {"probability": 0.1},
                "duplicate": {"probability": 0.1},
                "clock": {"offset": 0.1},
                "trigger_delay": {"delay": 0.01},
                "calibration": {"rotation": 1, "drift": {"rotation": 1}},
                "flicker": {"frequency": 100},
                "exposure_steps": {"probability": 0.1},
                "dirt": {"spots": 3},
            },
        },
        "right": {
            "trajectory": {"file": "path.txt"},
            "depth_sensor": {"preset": "realsense_d435"},
            "stereo": {"baseline": 0.1},
        },
    },
    "robot": {
        "mesh": "ball.obj",
        "trajectory": {"file": "path.txt"},
        "vibration": {"position": 0.001},
    },
    "scanners": {
        "lidar": {"model": "velodyne_vlp16", "trajectory": {"file": "path.txt"}},
        "own": {"pattern": {"columns": 90}, "rate": 10, "range": [0.1, 30], "position": [0, 0, 1]},
    },
    "world": {"meshes": [{"file": "ball.obj"}], "background": "photo.png", "environment": "sky.png"},
    "about": {"title": "Two people"},
    "light": {"strength": 0.9},
    "randomise": {"camera_jitter": {"position": 0.1}},
    "time": {"wait_for": [{"topic": "/tracker/poses"}]},
    "adapters": {
        "detections_2d": {"cameras": ["left"]},
        "detections_3d": {"frame": "odom"},
        "people": {"frame": "map"},
        "tracked_persons": {"camera": "left"},
    },
    "hri": {"camera": "left"},
}
FILE_KEYS = (
    "humans.anna.body",
    "humans.anna.motion.file",
    "humans.anna.motion.joint_names",
    "humans.anna.keyframes.file",
    "humans.anna.face.file",
    "variety.bodies",
    "variety.motions",
    "crowd.bodies",
    "crowd.motions",
    "objects.ball.mesh",
    "objects.ball.keyframes.file",
    "rig.file",
    "rig.background.a",
    "cameras.left.calibration",
    "cameras.left.background",
    "cameras.right.trajectory.file",
    "robot.mesh",
    "robot.trajectory.file",
    "scanners.lidar.trajectory.file",
    "world.meshes.0.file",
    "world.background",
    "world.environment",
)
#: Suffixes of the files of keys whose value above has none.
SUFFIXES = {
    "humans.anna.body": ".npz",
    "variety.bodies": ".obj",
    "variety.motions": ".bvh",
    "crowd.bodies": ".obj",
    "crowd.motions": ".bvh",
    "humans.anna.motion.file": ".bvh",
}
KEYS_XML = """\
<animation startframe="0" endframe="9" rate="30">
  <object name="anna"><frame number="0"><position x="1" y="2" z="0"/></frame></object>
  <object name="ball"><frame number="0"><position x="1" y="2" z="0"/></frame></object>
</animation>
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all files of the scene, and with folders and damaged files for the same keys."""
    folder = tmp_path_factory.mktemp("scene")
    cameras = {name: Camera.look_at((4, 0, 1.5), (0, y, 1), (64, 48)) for y, name in enumerate("ab")}
    write_calibration(folder / "rig.json", cameras, "panoptic")
    (folder / "table.yaml").write_bytes((ROOT / "config/joint_names/biovision.yaml").read_bytes())
    (folder / "keys.xml").write_text(KEYS_XML)
    (folder / "ball.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "take.csv").write_text("Timecode,BlendShapeCount,JawOpen\n00:00:00:01,1,0.5\n")
    (folder / "path.txt").write_text("0 0 0 1 0 0 0 1\n")
    (folder / "photo.png").write_bytes(encode_image(np.zeros((8, 8, 3), np.uint8)).tobytes())
    (folder / "sky.png").write_bytes(encode_image(np.zeros((8, 16, 3), np.uint8)).tobytes())
    for suffix in (".npz", ".obj", ".bvh", ".csv", ".yaml", ".xml", ".json", ".txt", ".png"):
        (folder / f"folder{suffix}").mkdir()
        (folder / f"damaged{suffix}").write_text("{[ these are words\n")
    return folder


def changed(key: str, value: Any) -> dict[str, Any]:
    """The section of a key with another value, and a camera: the other sections only take time."""
    *sections, last = (int(part) if part.isdigit() else part for part in key.split("."))
    scene: dict[str, Any] = {"cameras": {"left": SCENE["cameras"]["right"]}}
    if sections:
        scene[sections[0]] = copy.deepcopy(SCENE[sections[0]])
    section: Any = scene
    for part in sections:
        section = section[part]
    section[last] = value
    return scene


def write(path: Path, scene: dict[str, Any], marked: str) -> int:
    """Write a scene file with ``marked`` in place of MARKED; return the line of it."""
    lines = yaml.safe_dump(scene, sort_keys=False).replace("MARKED", marked)
    path.write_text(lines)
    return next(number for number, line in enumerate(lines.split("\n"), 1) if marked in line)


def error_of(scene: Path, read: Any = Scene.load) -> HumansimError:
    with pytest.raises(HumansimError) as caught:
        read(scene)
    error = caught.value
    assert str(error).startswith(f"{scene}:{error.line}: {error.key}: ")
    return error


# --- keys that name files


def test_the_scene_has_all_keys_that_name_files(folder: Path) -> None:
    path = folder / "complete.yaml"
    path.write_text(yaml.safe_dump(SCENE, sort_keys=False))
    scene = Scene.load(path)
    assert list(scene.cameras) == ["a", "b", "left", "right", "right_right"]
    found: list[str] = []
    map_files(load_config(path).model_dump(exclude_unset=True), lambda name: found.append(name) or name)
    assert len(found) == len(FILE_KEYS)
    kinds = {re.sub(r"\.(anna|ball|left|right|lidar|a|0)\b", "", key) for key in FILE_KEYS}
    # extrinsics need a file of intrinsics beside them: test_scene_cameras.py
    kinds |= {"rig.extrinsics", "cameras.extrinsics"}
    assert kinds == {re.sub(r"\.\*", "", key) for key in file_keys(SceneConfig)}


def file_keys(model: type[BaseModel], prefix: str = "") -> set[str]:
    """Keys of a section and those below it that name files; ``*`` stands for any name."""
    keys = set()
    for name, info in model.model_fields.items():
        annotations = [(prefix + name, info.annotation, info.metadata)]
        while annotations:
            key, annotation, metadata = annotations.pop()
            metadata = [*metadata, *getattr(annotation, "__metadata__", ())]
            if any(isinstance(part, AfterValidator) for part in metadata):
                keys.add(key)
            elif isinstance(annotation, type) and issubclass(annotation, BaseModel):
                keys |= file_keys(annotation, f"{key}.")
            else:
                annotations += [(key, inner, []) for inner in get_args(annotation)]
    return keys


@pytest.mark.daily("*-missing", "humans.*-damaged")
@pytest.mark.parametrize("fault", ["missing", "folder", "damaged", "nul"])
@pytest.mark.parametrize("key", FILE_KEYS)
def test_a_file_that_cannot_be_read_is_named_with_its_key(folder: Path, key: str, fault: str) -> None:
    value: Any = SCENE
    for part in key.split("."):
        value = value[int(part) if part.isdigit() else part]
    suffix = SUFFIXES.get(key) or Path(value).suffix
    name = "a\\0b" if fault == "nul" else fault + suffix
    path = folder / "scene.yaml"
    line = write(
        path, changed(key, "MARKED"), f'["{name}"]' if key.startswith(("variety", "crowd")) else f'"{name}"'
    )
    error = error_of(path)
    assert (error.path, error.line) == (str(path), line)
    assert error.key == key
    if fault == "damaged":
        assert isinstance(error.__cause__, HumansimError)
    # a joint table is a name or a path
    shown = "a\\x00b" if fault == "nul" else name if key.endswith("joint_names") else str(folder / name)
    assert shown in error.message
    if isinstance(error.__cause__, HumansimError):
        assert error.message == str(error.__cause__)
        assert error.__cause__.path is not None


def test_the_list_of_nodes_names_the_key_of_a_missing_rig(folder: Path) -> None:
    path = folder / "run.yaml"
    line = write(path, changed("rig.file", "MARKED"), "gone.json")
    error = error_of(path, scene_processes)
    assert (error.line, error.key) == (line, "rig.file")


def located_error(folder: Path, key: str, text: str) -> HumansimError:
    """The error of a scene with a text as the value of a key; it has the file and the line of the key."""
    path = folder / "scene.yaml"
    line = write(path, changed(key, "MARKED"), text)
    error = error_of(path)
    assert (error.path, error.line) == (str(path), line)
    return error


def test_a_wrong_outfit_is_named_with_its_key(folder: Path) -> None:
    assert located_error(folder, "humans.anna.outfit", "armour").key == "humans.anna.outfit"


# --- sections


def sections(value: Any, model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    """Key and model of each section of a scene."""
    yield prefix, model
    for name, part in value.items():
        annotation = model.model_fields[name].annotation
        inner = next(iter(models(annotation)), None)
        if inner is None:
            continue
        parts: Any = {name: part}
        if isinstance(part, list):
            parts = {f"{name}.{index}": entry for index, entry in enumerate(part)}
        elif "dict" in str(annotation):
            parts = {f"{name}.{entry}": settings for entry, settings in part.items()}
        for key, settings in parts.items():
            yield from sections(settings, inner, f"{prefix}{key}.")


def models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from models(inner)


SECTIONS = dict(sections(SCENE, SceneConfig))
LIMITS = (annotated_types.Ge, annotated_types.Gt, annotated_types.Le, annotated_types.Lt)


def out_of_range() -> Iterator[tuple[str, str]]:
    """Each key with a limit, and a value beyond it."""
    for prefix, model in SECTIONS.items():
        for name, info in model.model_fields.items():
            for limit in (part for part in info.metadata if isinstance(part, LIMITS)):
                low = isinstance(limit, LIMITS[:2])
                yield prefix + name, "-987654321" if low else "987654321"


def test_all_sections_are_there() -> None:
    # a robot has a path or a trajectory, an object keyframes or hands that hold it, variety bodies or people
    others = {PathConfig, HoldConfig, PeopleConfig}
    assert set(SECTIONS.values()) == {SceneConfig, *all_models(SceneConfig)} - others


def all_models(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    for info in model.model_fields.values():
        for inner in models(info.annotation):
            yield inner
            yield from all_models(inner)


@pytest.mark.parametrize("prefix", SECTIONS, ids=lambda prefix: prefix or "top")
def test_an_unknown_key_of_any_section_is_named(tmp_path: Path, prefix: str) -> None:
    error = located_error(tmp_path, f"{prefix}colour_of_it", "deep_red")
    assert error.key == f"{prefix}colour_of_it"
    assert re.match(r"unknown key; (.* K|k)nown here: ", error.message)


@pytest.mark.parametrize("text", ['"two\\nlines"', '"\\u202eMIT"', "x" * 201])
def test_a_licence_that_is_no_line_is_named(tmp_path: Path, text: str) -> None:
    error = located_error(tmp_path, "license", text)
    assert error.key == "license"
    assert "a licence is one line of at most 200 characters" in error.message


WRONG_TYPES = [
    (prefix + name, "[[wrong_type]]") for prefix in SECTIONS for name in SECTIONS[prefix].model_fields
]


@pytest.mark.parametrize(("key", "value"), [*WRONG_TYPES, *out_of_range()])
def test_a_value_of_the_wrong_type_or_out_of_range_is_named(tmp_path: Path, key: str, value: str) -> None:
    error = located_error(tmp_path, key, value)
    assert error.key is not None and f"{error.key}.".startswith(f"{key}.")
