"""Faces of glTF and VRM files: which morph targets and expressions count, and what is refused."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from figures import glb, gltf_text
from motion_files import stand_in, walk
from motion_formats import write_vrma
from scipy.spatial.transform import Rotation

from humansim_ros import Scene
from humansim_ros.errors import HumansimError, MotionError
from humansim_ros.motion.body.face import ACTIONS, expression
from humansim_ros.motion.files.files import read_motion
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.live import LiveRetargeter
from humansim_ros.scene.core.playback import Playback
from humansim_ros.scene.features.face.files import read_face_file
from humansim_ros.scene.features.face.layer import WeightTrack
from humansim_ros.types import Array

CAMERAS = {"front": {"position": [3, 0, 1.6], "look_at": [0, 0, 1.5]}}
TIMES = (0.0, 0.5, 1.0)
#: Three morph targets: two with names of actions as exporters write them, and one without.
NAMES = ("JawOpen", "Hair", "mouthSmile_L")
WEIGHTS = ((0.0, 0.3, 0.2), (0.8, 0.3, 0.2), (0.4, 0.3, 1.0))


def write_face(
    path: Path,
    names: Sequence[str] = NAMES,
    values: Sequence[object] = WEIGHTS,
    times: Sequence[float] = TIMES,
    interpolation: str = "LINEAR",
    change: Callable[[dict[str, Any]], object] = lambda content: None,
) -> Path:
    """Write a mesh of one triangle whose morph targets an animation moves; ``change``: of the JSON part."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    arrays = [np.asarray(each, "<f4") for each in (corners, times, values)]
    data = b"".join(each.tobytes() for each in arrays)
    starts = np.cumsum([0, *(each.nbytes for each in arrays)]).tolist()
    target = {"node": 0, "path": "weights"}
    content: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "nodes": [{"name": "Head", "mesh": 0}],
        "meshes": [
            {
                "primitives": [{"attributes": {"POSITION": 0}, "targets": [{"POSITION": 0}] * len(names)}],
                "extras": {"targetNames": list(names)},
            }
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": len(times), "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5126, "count": arrays[2].size, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": each.nbytes}
            for start, each in zip(starts, arrays, strict=False)
        ],
        "buffers": [{"byteLength": len(data)}],
        "animations": [
            {
                "name": "Talk",
                "channels": [{"sampler": 0, "target": target}],
                "samplers": [{"input": 1, "output": 2, "interpolation": interpolation}],
            }
        ],
    }
    change(content)
    path.write_bytes(gltf_text(content, data) if path.suffix == ".gltf" else glb(content, data))
    return path


def weights(track: WeightTrack, action: str, times: Sequence[float]) -> Array:
    out = np.zeros((len(times), len(ACTIONS)))
    out[:, list(track.actions)] = track.at(np.array(times))
    return out[:, ACTIONS.index(action)]


@pytest.mark.parametrize("suffix", ["glb", "gltf", "vrm"])
def test_morph_targets_with_names_of_arkit_move_a_face(tmp_path: Path, suffix: str) -> None:
    path = write_face(tmp_path / f"take.{suffix}")
    track = read_face_file(path)
    assert {ACTIONS[action] for action in track.actions} == {"jawOpen", "mouthSmileLeft"}
    times = [-1.0, 0.0, 0.25, 0.5, 0.8, 1.0, 7.0]
    np.testing.assert_allclose(weights(track, "jawOpen", times), [0, 0, 0.4, 0.8, 0.56, 0.4, 0.4], atol=1e-6)
    np.testing.assert_allclose(
        weights(track, "mouthSmileLeft", times), [0.2, 0.2, 0.2, 0.2, 0.68, 1, 1], atol=1e-6
    )
    scene = Scene.from_dict({"cameras": CAMERAS, "humans": {"anna": {"face": {"file": f"{path}#Talk"}}}})
    face = scene.actors["anna"].at(0.25).face
    assert face is not None and face.weights[ACTIONS.index("jawOpen")] == pytest.approx(0.4, abs=1e-6)
    assert face.rates[ACTIONS.index("jawOpen")] == pytest.approx(1.6, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "action"),
    [
        ("eyeBlink_L", "eyeBlinkLeft"),
        ("EYEBLINKRIGHT", "eyeBlinkRight"),
        ("blendShape1.eyeLookIn_R", "eyeLookInRight"),
        ("mouth_L", "mouthLeft"),
        ("brow_inner_up", "browInnerUp"),
        ("cheekSquint.R", "cheekSquintRight"),
        ("jaw_Left", "jawLeft"),
    ],
)
def test_spellings_of_exporters_are_known(tmp_path: Path, name: str, action: str) -> None:
    track = read_face_file(write_face(tmp_path / "take.glb", [name], [0.0, 0.5, 1.0]))
    assert weights(track, action, [0.5, 1.0]).tolist() == pytest.approx([0.5, 1.0])
    assert len(track.actions) == 1


def test_names_may_be_at_a_primitive(tmp_path: Path) -> None:
    def move(content: dict[str, Any]) -> None:
        mesh = content["meshes"][0]
        mesh["primitives"][0]["extras"] = mesh.pop("extras")

    assert len(read_face_file(write_face(tmp_path / "take.glb", change=move)).actions) == 2


def test_steps_and_cubic_splines_are_interpolated_as_the_format_says(tmp_path: Path) -> None:
    step = read_face_file(write_face(tmp_path / "step.glb", interpolation="STEP"))
    np.testing.assert_allclose(
        weights(step, "jawOpen", [0.1, 0.45, 0.5, 0.95, 1.0]), [0, 0, 0.8, 0.8, 0.4], atol=1e-6
    )
    # tangents of 0 at both ends: the smooth step of glTF's formula
    rows = [[0.0], [0.0], [0.0]], [[0.0], [1.0], [0.0]]
    cubic = read_face_file(
        write_face(tmp_path / "cubic.glb", ["jawOpen"], rows, times=[2.0, 4.0], interpolation="CUBICSPLINE")
    )
    shares = np.linspace(0, 1, 9)
    expected = shares**2 * (3 - 2 * shares)
    np.testing.assert_allclose(weights(cubic, "jawOpen", (2 * shares).tolist()), expected, atol=1e-6)


def test_the_largest_weight_of_several_meshes_counts(tmp_path: Path) -> None:
    def add_teeth(content: dict[str, Any]) -> None:
        content["nodes"].append({"name": "Teeth", "mesh": 1})
        content["meshes"].append(
            {**content["meshes"][0], "extras": {"targetNames": ["", "jawOpen", "eyeBlinkLeft"]}}
        )
        (channel,) = content["animations"][0]["channels"]
        content["animations"][0]["channels"].append({**channel, "target": {"node": 1, "path": "weights"}})

    track = read_face_file(write_face(tmp_path / "take.glb", change=add_teeth))
    assert weights(track, "jawOpen", [0.0, 0.5]).tolist() == pytest.approx([0.3, 0.8])


def with_expressions(path: Path, expressions: dict[str, Sequence[float]], kind: str = "preset") -> Path:
    """Write a VRM animation of a body, whose expressions are the first keys of its first joint's position."""
    person = stand_in("mixamo")
    root = np.zeros((5, 3))
    root[:, 0] = np.asarray(next(iter(expressions.values()))) * 100  # the writer's unit is a centimetre

    def add(content: dict[str, Any]) -> None:
        (moved,) = (c for c in content["animations"][0]["channels"] if c["target"]["path"] == "translation")
        node = len(content["nodes"]) - 1  # the node that write_vrma adds
        content["animations"][0]["channels"].append(
            {"sampler": moved["sampler"], "target": {"node": node, "path": "translation"}}
        )
        content["animations"][0]["channels"].remove(moved)
        content["extensions"]["VRMC_vrm_animation"]["expressions"] = {
            kind: {name: {"node": node} for name in expressions}
        }

    return write_vrma(path, person, walk(5), root, change=add)


@pytest.mark.parametrize(
    ("preset", "kind", "full"),
    [
        ("happy", "preset", expression("happiness")),
        ("surprised", "preset", expression("surprise")),
        ("blinkRight", "preset", {"eyeBlinkRight": 1.0}),
        ("lookLeft", "preset", {"eyeLookOutLeft": 1.0, "eyeLookInRight": 1.0}),
        ("aa", "preset", {"jawOpen": 0.45}),
        ("MouthPucker", "custom", {"mouthPucker": 1.0}),
    ],
)
def test_expressions_of_a_vrm_animation_move_a_face(
    tmp_path: Path, preset: str, kind: str, full: dict[str, float]
) -> None:
    path = with_expressions(tmp_path / "take.vrma", {preset: [0, 0, 0.5, 1, 1]}, kind)
    track = read_face_file(path)
    for action, weight in full.items():
        got = weights(track, action, [0, 2 / 30, 3 / 30, 9])
        np.testing.assert_allclose(got, np.array([0, 0.5, 1, 1]) * weight, atol=1e-5)
    assert read_motion(path).n_joints > 15  # the body of the file still plays


def test_a_published_vrm_animation_smiles(shared_data: Path) -> None:
    track = read_face_file(shared_data / "other" / "test.vrma")
    full = expression("happiness")
    looks = {"eyeLookInLeft", "eyeLookInRight", "eyeLookOutLeft", "eyeLookOutRight"}
    assert {ACTIONS[action] for action in track.actions} == set(full) | looks  # its gaze turns to both sides
    assert weights(track, "mouthSmileLeft", np.arange(0, 3, 0.01).tolist()).max() == pytest.approx(
        full["mouthSmileLeft"]
    )
    with pytest.raises(MotionError, match="the file has no animation"):
        read_face_file(shared_data / "mesh" / "rpm_6505ad3b.glb")


def test_presets_of_a_vrm_avatar_name_its_morph_targets(tmp_path: Path) -> None:
    def bind(content: dict[str, Any]) -> None:
        binds = [{"node": 0, "index": 1, "weight": 0.5}]
        content["extensions"] = {
            "VRMC_vrm": {"expressions": {"preset": {"angry": {"morphTargetBinds": binds}}}}
        }

    path = write_face(
        tmp_path / "avatar.vrm", ["a", "Fcl_ALL_Angry"], [[0, 0], [0, 0.25], [0, 0.5]], change=bind
    )
    got = weights(read_face_file(path), "browDownLeft", [0.5, 1.0])
    np.testing.assert_allclose(got, np.array([0.5, 1]) * expression("anger")["browDownLeft"], atol=1e-6)


@pytest.mark.parametrize(
    ("group", "action", "full"),
    [
        ({"presetName": "angry"}, "browDownLeft", expression("anger")["browDownLeft"]),
        ({"presetName": "Joy"}, "mouthSmileLeft", expression("happiness")["mouthSmileLeft"]),
        ({"presetName": "blink_r"}, "eyeBlinkRight", 1.0),
        ({"presetName": "lookleft"}, "eyeLookInRight", 1.0),
        ({"presetName": "a"}, "jawOpen", 0.45),
        (
            {"presetName": "unknown", "name": "Surprised"},
            "eyeWideLeft",
            expression("surprise")["eyeWideLeft"],
        ),
        ({"name": "JawOpen"}, "jawOpen", 1.0),
    ],
)
def test_blend_shape_groups_of_a_vrm_0_avatar_name_its_morph_targets(
    tmp_path: Path, group: dict[str, str], action: str, full: float
) -> None:
    def bind(content: dict[str, Any]) -> None:
        binds = [{"mesh": 0, "index": 1, "weight": 50}]
        content["extensions"] = {
            "VRM": {"blendShapeMaster": {"blendShapeGroups": [{**group, "binds": binds}]}}
        }

    path = write_face(tmp_path / "avatar.vrm", ["a", "Fcl"], [[0, 0], [0, 0.25], [0, 0.5]], change=bind)
    got = weights(read_face_file(path), action, [0.5, 1.0])
    np.testing.assert_allclose(got, np.array([0.5, 1]) * full, atol=1e-6)


def with_gaze(path: Path, yaw: float, pitch: float, **look: Any) -> Path:
    """Write a VRM animation of a face whose gaze turns from straight ahead by degrees to left and up."""
    turn = Rotation.from_euler("YX", [yaw, -pitch], degrees=True).as_quat()

    def add(content: dict[str, Any]) -> None:
        content["nodes"].append({"name": "lookAt"})
        content["meshes"][0]["extras"]["targetNames"] = []
        content["animations"][0]["channels"] = [{"sampler": 0, "target": {"node": 1, "path": "rotation"}}]
        content["accessors"][2].update(type="VEC4", count=2)
        content["extensions"] = {"VRMC_vrm_animation": {"lookAt": {"node": 1, **look}}}

    return write_face(path, ["x"], [[0, 0, 0, 1], turn], times=[0, 1], change=add)


@pytest.mark.parametrize(("yaw", "pitch"), [(22.0, 0.0), (-30.0, 14.0), (10.0, -20.0), (0.0, 60.0)])
def test_the_gaze_of_a_vrm_animation_turns_the_eyes(tmp_path: Path, yaw: float, pitch: float) -> None:
    path = with_gaze(tmp_path / "take.vrma", yaw, pitch)
    scene = Scene.from_dict({"cameras": CAMERAS, "humans": {"anna": {"face": {"file": str(path)}}}})
    actor = scene.actors["anna"]
    rest, state = actor.at(0.0), actor.at(1.0)
    names = state.joint_names
    head = rest.joints[names.index("vt3"), :3, :3] @ actor.human.skeleton.rest[names.index("vt3"), :3, :3].T
    moved = state.joints[names.index("vt3"), :3, :3] @ actor.human.skeleton.rest[names.index("vt3"), :3, :3].T
    for eye in ("l_eyeball_joint", "r_eyeball_joint"):
        (x0, y0, z0), (x, y, z) = (
            axes.T @ each.joints[names.index(eye), :3, 1] for axes, each in ((head, rest), (moved, state))
        )
        turned = np.degrees([np.arctan2(x, z) - np.arctan2(x0, z0), np.arcsin(y) - np.arcsin(y0)])
        np.testing.assert_allclose(turned, [yaw, min(pitch, 28.0)], atol=0.2)  # the limit of the eyes


def test_the_face_of_a_file_is_in_time_with_its_body(tmp_path: Path) -> None:
    """The body of a file plays from its first key, and so does the face, whose first key is later."""

    def add_body(content: dict[str, Any]) -> None:
        content["nodes"].append({"name": "Hips"})
        content["accessors"].append({**content["accessors"][1], "count": 2})  # keys at 0.25 and 0.75 s
        content["accessors"].append({"componentType": 5126, "count": 2, "type": "VEC3"})
        animation = content["animations"][0]
        animation["channels"].append({"sampler": 1, "target": {"node": 1, "path": "translation"}})
        animation["samplers"].append({"input": 3, "output": 4})
        content["accessors"][1]["byteOffset"] = 4  # the face has the later two
        content["accessors"][1]["count"], content["accessors"][2]["count"] = 2, 2

    path = write_face(
        tmp_path / "take.glb", ["jawOpen"], [0.0, 1.0, 0.0], [0.25, 0.75, 1.25], change=add_body
    )
    track = read_face_file(path)
    assert weights(track, "jawOpen", [0.5, 0.75, 1.0]).tolist() == pytest.approx([0.0, 0.5, 1.0])


def test_a_face_of_the_file_of_the_body_plays_with_the_body(tmp_path: Path) -> None:
    path = with_expressions(tmp_path / "take.vrma", {"MouthPucker": [0, 0.25, 0.5, 0.75, 1]}, "custom")
    pucker, cycle = ACTIONS.index("mouthPucker"), 4 / 30

    def actor(face: str | Path, **motion: object) -> Actor:
        human = {"motion": {"file": str(path), **motion}, "face": {"file": str(face)}}
        return Scene.from_dict({"room": None, "cameras": CAMERAS, "humans": {"anna": human}}).actors["anna"]

    def weight(person: Actor, time: float) -> float:
        face = person.at(time).face
        assert face is not None and np.abs(face.rates).max() < 30  # also where a cycle begins
        return float(face.weights[pucker])

    looping = actor(path)
    times = [0.0, 0.4 * cycle, 0.9 * cycle, 1.4 * cycle, 7.25 * cycle]
    assert [weight(looping, time) for time in times] == pytest.approx([0, 0.4, 0.9, 0.4, 0.25], abs=1e-4)
    assert weight(looping, cycle) in (pytest.approx(0, abs=1e-3), pytest.approx(1, abs=1e-3))
    slow = actor(path, speed=0.5, offset=0.2 * cycle, loop="none")
    assert [weight(slow, 0.4 * cycle), weight(slow, 9)] == pytest.approx([0.3, 1], abs=1e-4)
    sent = LiveRetargeter(looping).retarget(looping.joint_poses(1.4 * cycle))
    assert np.array_equal(sent.vertices, looping.at(1.4 * cycle).vertices)
    other = tmp_path / "face.vrma"
    other.write_bytes(path.read_bytes())
    assert weight(actor(other), 7.25 * cycle) == pytest.approx(1, abs=1e-4)  # once


def test_the_face_of_a_file_waits_while_another_motion_plays(tmp_path: Path) -> None:
    path = with_expressions(tmp_path / "take.vrma", {"MouthPucker": [1, 1, 1, 1, 1]}, "custom")
    human = {"motion": {"file": str(path)}, "face": {"file": str(path)}}
    playback = Playback(Scene.from_dict({"room": None, "cameras": CAMERAS, "humans": {"anna": human}}))
    playback.elapsed = 0
    for motion, expected in (("stand", 0.0), (str(path), 1.0)):
        playback.change("anna", file=motion)
        face = playback.actors["anna"].at(0.5).face
        weight = 0.0 if face is None else face.weights[ACTIONS.index("mouthPucker")]
        assert weight == pytest.approx(expected)


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "other names": (
        {"names": ["viseme_aa", "Smile", "x"]},
        r"'Talk' moves no face.*it has 'viseme_aa', 'Smile', 'x'",
    ),
    "no names": ({"change": lambda c: c["meshes"][0].pop("extras")}, "moves no face.*no morph targets"),
    "names that are no list": ({"change": lambda c: c["meshes"][0].update(extras=3)}, "moves no face"),
    "NaN": ({"values": [[np.nan, 0, 0]] * 3}, "accessors.2.*not finite"),
    "more than 1": (
        {"values": [[0, 0, 0], [1.2, 0, 0], [0, 0, 0]]},
        "weight of jawOpen must be from 0 to 1, not 1.2 at 0.5 s",
    ),
    "less than 0": ({"values": [[-0.1, 0, 0]] * 3}, "not -0.1 at 0 s"),
    "too few values": ({"values": [0.0] * 6}, "accessors.2: 6 values for 3 keys of 3 weights"),
    "a short buffer": ({"change": lambda c: c["accessors"][2].update(count=900)}, "too short for 900 values"),
    "vectors": (
        {"change": lambda c: c["accessors"][2].update(type="VEC3", count=3)},
        "must be SCALAR, not VEC3",
    ),
    "times that go back": ({"times": [0, 2, 1]}, "key times must increase"),
    "a missing accessor": (
        {"change": lambda c: c["animations"][0]["samplers"][0].update(output=9)},
        "9 does not exist",
    ),
    "a missing node": (
        {"change": lambda c: c["animations"][0]["channels"][0]["target"].update(node=9)},
        "node 9 does not exist",
    ),
    "a mesh without targets": (
        {"change": lambda c: c["meshes"][0]["primitives"][0].pop("targets")},
        "node 0 has no morph targets",
    ),
    "no primitives": (
        {"change": lambda c: c["meshes"][0].update(primitives=[])},
        "node 0 has no morph targets",
    ),
    "a gaze that is no rotation": (
        {
            "change": lambda c: c.update(
                extensions={"VRMC_vrm_animation": {"lookAt": {"node": 0}}},
                animations=[
                    {
                        "channels": [{"sampler": 0, "target": {"node": 0, "path": "rotation"}}],
                        "samplers": [{"input": 1, "output": 2}],
                    }
                ],
            )
        },
        "rotation of the wrong width|must be|values",
    ),
    "no animation": ({"change": lambda c: c.update(animations=[])}, "the file has no animation"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_wrong_face_of_a_gltf_file_is_refused(tmp_path: Path, case: str) -> None:
    options, message = BAD[case]
    with pytest.raises(MotionError, match=rf"(?s)take\.glb: .*{message}"):
        read_face_file(write_face(tmp_path / "take.glb", **options))


def test_an_animation_is_chosen_by_name_and_a_missing_one_is_said_with_its_key(tmp_path: Path) -> None:
    def add_wave(content: dict[str, Any]) -> None:
        content["animations"].insert(0, {"name": "Wave", "channels": [], "samplers": []})

    path = write_face(tmp_path / "take.glb", change=add_wave)
    assert len(read_face_file(path).actions) == 2  # the first that moves a face
    with pytest.raises(MotionError, match="'Wave' moves no face"):
        read_face_file(path, "Wave")
    with pytest.raises(HumansimError, match=r"humans\.anna\.face\.file: .*no animation 'Tlk'"):
        Scene.from_dict({"cameras": CAMERAS, "humans": {"anna": {"face": {"file": f"{path}#Tlk"}}}})


def test_a_hostile_bone_map_or_bind_is_ignored_or_refused(tmp_path: Path) -> None:
    for extensions in (
        {
            "VRMC_vrm": {
                "expressions": {"preset": {"happy": {"morphTargetBinds": [{"node": [], "index": {}}, 3]}}}
            }
        },
        {"VRMC_vrm": {"expressions": {"preset": [1]}}},
        {"VRMC_vrm_animation": {"expressions": {"preset": {"happy": {"node": []}}, "custom": 3}}},
        {"VRMC_vrm_animation": 7},
        {"VRMC_vrm_animation": {"lookAt": {"node": "Head"}}},
        {"VRMC_vrm_animation": {"lookAt": {"node": 99}}},
        {"VRM": {"blendShapeMaster": {"blendShapeGroups": {"joy": 1}}}},
        {"VRM": {"blendShapeMaster": {"blendShapeGroups": [7, {"presetName": 3, "name": [], "binds": [2]}]}}},
        {
            "VRM": {
                "blendShapeMaster": {
                    "blendShapeGroups": [
                        {"presetName": "joy", "binds": [{"mesh": 0, "index": 1, "weight": unit}]}
                        for unit in (0, -5, 101, "all", None)
                    ]
                    + [{"presetName": "joy", "binds": [{"mesh": 8, "index": 9, "weight": 100}]}]
                }
            }
        },
    ):
        path = write_face(tmp_path / "take.glb", change=lambda c, e=extensions: c.update(extensions=e))
        assert len(read_face_file(path).actions) == 2
