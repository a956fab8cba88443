"""Animations of glTF files without a mesh, and VRM animations: their joints, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motion_files import stand_in, walk
from motion_formats import VRM_BONES, write_gltf_animation, write_vrma

from humansim_ros.errors import MotionError
from humansim_ros.motion import match_motion, read_motion, to_world

PERSON = stand_in("mixamo")
TURNS, ROOT = walk(12, heading=30), np.linspace([0, 0, 0], [5, 2, 90], 12)
EXPECTED = PERSON.positions(TURNS, ROOT)[:, : len(PERSON.names)] * 0.01


def test_bones_of_a_vrm_animation_are_where_forward_kinematics_puts_them(tmp_path: Path) -> None:
    motion = read_motion(write_vrma(tmp_path / "walk.vrma", PERSON, TURNS, ROOT))
    joints = [motion.joint(VRM_BONES[role]) for role in PERSON.roles]
    assert motion.n_joints == len(joints)  # expressions are no bones
    times = np.linspace(0, motion.n_frames - 1, 12).round().astype(int)
    np.testing.assert_allclose(motion.world_positions(times)[:, joints], EXPECTED, atol=1e-5)
    match = match_motion(motion)
    assert (match.table, match.by, match.confidence) == ("unity", "names", 1.0)


def test_a_vrm_animation_stands_and_faces_as_it_was_made(tmp_path: Path) -> None:
    world = to_world(read_motion(write_vrma(tmp_path / "walk.vrma", PERSON, TURNS)))
    assert (world.frame.up, world.frame.facing, world.frame.unit) == ("y", "z", 1.0)
    assert world.frame.offsets_stand


@pytest.mark.parametrize("scale", [1.0, 0.01])
@pytest.mark.parametrize("family", ["mixamo", "unreal", "biovision"])
def test_nodes_without_a_mesh_are_where_forward_kinematics_puts_them(
    tmp_path: Path, family: str, scale: float
) -> None:
    person = stand_in(family)
    motion = read_motion(write_gltf_animation(tmp_path / "walk.glb", person, TURNS, ROOT, scale=scale))
    joints = [motion.joint(name) for name in person.names]
    expected = person.positions(TURNS, ROOT)[:, : len(joints)] * 0.01
    times = np.linspace(0, motion.n_frames - 1, 12).round().astype(int)
    np.testing.assert_allclose(motion.world_positions(times)[:, joints], expected, atol=2e-5)
    assert match_motion(motion).confidence == 1


def test_joints_of_a_skin_without_a_mesh_are_the_skeleton(tmp_path: Path) -> None:
    def add_skin(content: dict[str, Any]) -> None:
        content["skins"] = [{"joints": list(range(1, 1 + len(PERSON.names)))}]
        content["nodes"].append({"name": "a camera that turns"})
        content["animations"][0]["channels"].append(
            {"sampler": 0, "target": {"node": len(content["nodes"]) - 1, "path": "rotation"}}
        )

    path = write_gltf_animation(tmp_path / "walk.glb", PERSON, TURNS, change=add_skin)
    assert "a camera that turns" not in read_motion(path).joint_names


def test_the_first_animation_that_turns_something_is_played(tmp_path: Path) -> None:
    def add_face(content: dict[str, Any]) -> None:
        walk = content["animations"][0]
        face = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        content["animations"].insert(0, {"name": "Face", "channels": [face], "samplers": walk["samplers"]})

    path = write_gltf_animation(tmp_path / "walk.glb", PERSON, TURNS, change=add_face)
    assert read_motion(path).n_joints >= len(PERSON.names)
    with pytest.raises(MotionError, match="no skeleton, and the animation turns nothing"):
        read_motion(f"{path}#Face")


def human_bones(content: dict[str, Any]) -> dict[str, Any]:
    bones: dict[str, Any] = content["extensions"]["VRMC_vrm_animation"]["humanoid"]["humanBones"]
    return bones


BAD: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "a node that is missing": (
        lambda c: human_bones(c)["hips"].update(node=999),
        r"no joint table fits .*which finds nothing for HumanoidRoot, Hips",
    ),
    "a bone that is missing": (
        lambda c: human_bones(c).pop("leftLowerLeg"),
        "which finds nothing for l_knee, LeftKnee",
    ),
    "no animation": (lambda c: c.update(animations=[]), "the file has no animation"),
    "a scale of 0": (lambda c: c["nodes"][0].update(scale=[0, 0, 0]), "singular"),
    "a cycle": (lambda c: c["nodes"][3].update(children=[1]), "two parents|cycle"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_wrong_vrm_animation_is_refused(tmp_path: Path, case: str) -> None:
    change, message = BAD[case]
    path = write_vrma(tmp_path / "walk.vrma", PERSON, TURNS, change=change)
    with pytest.raises(MotionError, match=message):
        match_motion(read_motion(path))


def test_a_vrm_animation_without_a_bone_map_is_matched_by_shape(tmp_path: Path) -> None:
    path = write_vrma(tmp_path / "w.vrma", PERSON, TURNS, change=lambda c: c.update(extensions={}))
    assert match_motion(read_motion(path)).by == "shape"


@pytest.mark.parametrize("kept", [11, 100, 2000, -10])
def test_a_cut_file_is_refused(tmp_path: Path, kept: int) -> None:
    path = write_vrma(tmp_path / "walk.vrma", PERSON, TURNS)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(MotionError):
        read_motion(path)


def test_a_published_vrm_animation_is_a_person(shared_data: Path) -> None:
    world = to_world(read_motion(shared_data / "other" / "test.vrma"))
    assert world.match.table == "unity" and world.match.confidence == 1
    assert world.frame.up == "y" and world.frame.facing == "z" and 1.6 < world.frame.stature < 1.8
