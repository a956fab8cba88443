"""glTF files whose nodes rest in another pose than that in which the skin was bound."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import figures
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from humansim_ros.files import read_mesh
from humansim_ros.motion import read_motion
from humansim_ros.people.loading.loading import load_human
from humansim_ros.scene.config.config import MotionConfig
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.types import Array

#: Rotations of the rest pose, degrees about x, y, z: the left arm is raised, the rest sits and turns.
POSE = {
    "Hips": (10, 35, 5),
    "Spine": (20, 0, 10),
    "Neck": (-30, 20, 0),
    "LeftArm": (30, -20, 75),
    "LeftForeArm": (0, -70, 20),
    "LeftHand": (50, 0, 30),
    "RightArm": (-20, 40, -60),
    "RightForeArm": (0, 100, 0),
    "RightHand": (-80, 0, 0),
    "LeftUpLeg": (-80, 0, 10),
    "LeftLeg": (85, 0, 0),
    "RightUpLeg": (-70, 0, -15),
    "RightLeg": (60, 0, 0),
    "RightFoot": (-40, 0, 0),
}

pytestmark = pytest.mark.usefixtures("no_cache")


def local_rotations(**changes: tuple[float, float, float]) -> Array:
    """Rotations (J, 3, 3) of the rest pose, in the parent joint."""
    pose = {**POSE, **changes}
    angles = np.array([pose.get(name, (0, 0, 0)) for name in figures.NAMES], float)
    return Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()


def world_transforms(local: Array, scale: float = 1.0) -> Array:
    """World transforms (J, 4, 4) of the joints, by a plain product along the tree."""
    out: list[Array] = []
    for joint, (_, parent, place) in enumerate(figures.JOINTS):
        above = figures.NAMES.index(parent) if parent else None
        step = np.eye(4)
        step[:3, :3] = local[joint]
        step[:3, 3] = np.array(place) - (0 if above is None else figures.PLACES[above])
        base = np.diag([scale, scale, scale, 1.0]) if above is None else out[above]
        out.append(base @ step)
    return np.array(out)


def skinned(world: Array) -> Array:
    """Vertices (V, 3) by the formula of glTF: sum of weight * joint * inverse bind matrix * vertex."""
    vertices, _, weights = figures.boxes()
    points = np.c_[vertices, np.ones(len(vertices))]
    out = np.zeros((len(vertices), 3))
    for joint in range(len(world)):
        inverse = np.eye(4)
        inverse[:3, 3] = -figures.PLACES[joint]
        out += weights[:, [joint]] * (points @ (world[joint] @ inverse).T)[:, :3]
    return out


def posed_document(scale: float = 1.0) -> tuple[dict[str, Any], bytes]:
    document, binary = figures.gltf()
    rotations = Rotation.from_matrix(local_rotations()).as_quat()
    for node, rotation in zip(document["nodes"], rotations, strict=False):
        node["rotation"] = rotation.tolist()
    document["nodes"].append({"name": "armature", "scale": [scale] * 3, "children": [0]})
    return document, binary


def written(path: Path, document: dict[str, Any], binary: bytes) -> Path:
    path.write_bytes(figures.glb(document, binary))
    return path


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_the_size_of_a_figure_is_that_of_its_bind_pose_whatever_its_rest_pose(
    tmp_path: Path, scale: float
) -> None:
    human = load_human(written(tmp_path / "posed.glb", *posed_document(scale)))
    vertices, _, _ = figures.boxes()
    shift = human.mesh.vertices[0] - scale * vertices[0]
    np.testing.assert_allclose(human.mesh.vertices, scale * vertices + shift, atol=1e-6)
    hip = human.skeleton.heads[human.skeleton.bone("l_hip")]
    np.testing.assert_allclose(
        hip, scale * figures.PLACES[figures.NAMES.index("LeftUpLeg")] + shift, atol=1e-6
    )


def test_a_joint_hidden_by_a_scale_of_zero_does_not_change_the_size(tmp_path: Path) -> None:
    document, binary = posed_document()
    for name in ("LeftHandMiddle1", "HeadTop_End"):
        document["nodes"][figures.NAMES.index(name)]["scale"] = [0, 0, 0]
    human = load_human(written(tmp_path / "posed.glb", document, binary))
    vertices, _, _ = figures.boxes()
    assert np.ptp(human.mesh.vertices[:, 1]) == pytest.approx(np.ptp(vertices[:, 1]), rel=1e-6)


def test_a_figure_in_another_rest_pose_moves_as_its_animation_says(tmp_path: Path) -> None:
    """The elbow turns from 0 to -80 degrees; all other joints keep the rotations of the rest pose."""
    path = written(tmp_path / "posed.glb", *posed_document())
    motion = read_motion(path)
    actor = Actor.build("x", 1, load_human(path), MotionConfig(file=str(path), loop="none"), SceneSource())
    for seconds, degrees in ((0.0, 0.0), (0.5, -40.0), (1.0, -80.0)):
        world = world_transforms(local_rotations(LeftForeArm=(0, degrees, 0)))
        frame = round(seconds / motion.frame_time)
        joints = motion.world_positions(frame)
        for number, name in enumerate(figures.NAMES):
            ours, theirs = joints[motion.joint(name)] - joints[0], world[number, :3, 3] - world[0, :3, 3]
            assert np.linalg.norm(ours) == pytest.approx(np.linalg.norm(theirs), abs=2e-6)
        ours, theirs = actor.at(seconds).vertices.astype(float), skinned(world)
        ours, theirs = ours - ours.mean(0), theirs - theirs.mean(0)
        turn, _ = Rotation.align_vectors(ours, theirs)  # where the figure stands and faces
        np.testing.assert_allclose(ours, turn.apply(theirs), atol=3e-5)


def test_a_skinned_object_has_the_pose_and_place_of_its_nodes(tmp_path: Path) -> None:
    """As an object, the figure is a mesh as viewers show it."""
    document, binary = posed_document(0.5)
    mesh = read_mesh(written(tmp_path / "posed.glb", document, binary))
    np.testing.assert_allclose(mesh.vertices, skinned(world_transforms(local_rotations(), 0.5)), atol=1e-6)
