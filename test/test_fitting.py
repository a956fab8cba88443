"""Joints moved into the limbs of a mesh, against the joints that the mesh's makers gave."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import numpy as np
import pytest
import trimesh
from conftest import SHARED_DATA, needs_shared_data
from numpy.typing import NDArray

from humansim_ros.body import Mesh, Skeleton, fit_to_skeleton, hanim_skeleton, read_mesh, rig
from humansim_ros.body.fitting import fit_limbs
from humansim_ros.errors import MeshError
from humansim_ros.rotations import Array

MESHES = SHARED_DATA / "mesh"
FIGURES = ("mh2007_male_T_dm.obj", "mh2007_female_A_dm.obj")
#: Our joint, the makers' joint, and how far ours may be from it, metres.
JOINTS = (
    ("l_hip", "LeftUpLeg", 0.06),
    ("l_knee", "LeftLeg", 0.03),
    ("l_ankle", "LeftFoot", 0.03),
    ("l_shoulder", "LeftArm", 0.02),
    ("l_elbow", "LeftForeArm", 0.03),
    ("l_wrist", "LeftHand", 0.02),
    ("r_hip", "RightUpLeg", 0.06),
    ("r_knee", "RightLeg", 0.03),
    ("r_ankle", "RightFoot", 0.03),
    ("r_shoulder", "RightArm", 0.02),
    ("r_elbow", "RightForeArm", 0.03),
    ("r_wrist", "RightHand", 0.02),
)

pytestmark = needs_shared_data


@cache
def fitted(figure: str) -> tuple[Mesh, Skeleton]:
    mesh = fit_to_skeleton(read_mesh(MESHES / figure), hanim_skeleton())
    return mesh, fit_limbs(hanim_skeleton(), mesh)


@cache
def makers_body() -> tuple[Array, dict[str, Any]]:
    """Vertices of the makers' T man in metres, and his joints."""
    joints = json.loads((MESHES / "joints_male_T_m.json").read_text())
    return read_mesh(MESHES / "human_male_T_uv_m.obj").vertices, joints


def makers_joint(name: str, vertices: Array) -> Array:
    """A joint of a body with the makers' topology: the sum of vertices that gives the joint of the T man."""
    man, joints = makers_body()
    joint = np.array(joints[name]["head"])
    near = np.argsort(np.linalg.norm(man - joint, axis=1))[:120]
    # coefficients that sum to one, the smallest there are: scaled, turned and moved bodies keep them
    equations = np.vstack([(man[near] - joint).T, np.ones(len(near))])
    coefficients = np.linalg.lstsq(equations, np.array([0.0, 0, 0, 1]), rcond=None)[0]
    return np.asarray(coefficients @ vertices[near])


@pytest.mark.parametrize("figure", FIGURES)
@pytest.mark.parametrize(("ours", "theirs", "tolerance"), JOINTS)
def test_joints_are_where_the_makers_have_them(figure: str, ours: str, theirs: str, tolerance: float) -> None:
    mesh, skeleton = fitted(figure)
    expected = makers_joint(theirs, mesh.vertices)
    assert np.linalg.norm(skeleton.heads[skeleton.bone(ours)] - expected) < tolerance


@pytest.mark.parametrize("figure", FIGURES)
def test_joints_of_the_limbs_lie_inside_the_mesh(figure: str) -> None:
    mesh, skeleton = fitted(figure)
    body = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    inside = body.ray.contains_points(skeleton.heads[[skeleton.bone(ours) for ours, _, _ in JOINTS]])
    assert inside.all()


@pytest.mark.parametrize("figure", FIGURES)
def test_the_fitted_skeleton_is_connected_and_symmetric(figure: str) -> None:
    _, skeleton = fitted(figure)
    for bone, parent in enumerate(skeleton.parents):
        if parent >= 0:
            np.testing.assert_allclose(skeleton.heads[bone], skeleton.tails[parent], atol=1e-12)
    for ours, _, _ in JOINTS[:6]:
        left = skeleton.heads[skeleton.bone(ours)]
        right = skeleton.heads[skeleton.bone(ours.replace("l_", "r_", 1))]
        np.testing.assert_allclose(left * [-1, 1, 1], right, atol=0.005)


@pytest.mark.parametrize("figure", FIGURES)
def test_a_mesh_whose_faces_share_no_vertices_is_fitted_alike(figure: str) -> None:
    """Programs that write a vertex for every corner tear the surface apart along all its edges."""
    mesh, skeleton = fitted(figure)
    torn = Mesh(mesh.vertices[mesh.faces.ravel()], np.arange(mesh.faces.size, dtype=np.int32).reshape(-1, 4))
    heads = fit_limbs(hanim_skeleton(), torn).heads
    assert np.linalg.norm(heads - skeleton.heads, axis=1).max() < 0.005


@pytest.mark.parametrize("figure", FIGURES)
def test_hands_follow_the_arm_alone(figure: str) -> None:
    """A finger tip beyond its bone's end would be rigged to what it sees under a larger angle: the thigh."""
    mesh, skeleton = fitted(figure)
    weights = rig(mesh, skeleton).toarray()
    for side in "lr":
        tip = skeleton.tails[skeleton.bone(f"{side}_wrist")]
        hand = np.linalg.norm(mesh.vertices - tip, axis=1) < 0.15
        arm = [skeleton.bone(f"{side}_{name}") for name in ("shoulder", "elbow", "wrist")]
        assert hand.sum() > 500
        np.testing.assert_allclose(weights[hand][:, arm].sum(1), 1)


def without(mesh: Mesh, gone: NDArray[np.bool_]) -> Mesh:
    """The mesh without some of its vertices and the faces that use them."""
    faces = mesh.faces[~gone[mesh.faces].any(1)]
    used = np.unique(faces)
    number = np.full(len(mesh.vertices), -1, dtype=np.int32)
    number[used] = np.arange(len(used))
    return Mesh(mesh.vertices[used], number[faces])


def test_an_arm_that_is_not_joined_is_refused() -> None:
    mesh, _ = fitted("mh2007_male_T_dm.obj")
    aside = np.abs(mesh.vertices[:, 0])
    with pytest.raises(MeshError, match="not joined"):
        fit_limbs(hanim_skeleton(), without(mesh, (aside > 0.3) & (aside < 0.4)))


def test_a_figure_without_arms_is_refused() -> None:
    mesh, _ = fitted("mh2007_male_T_dm.obj")
    with pytest.raises(MeshError, match="no limb"):
        fit_limbs(hanim_skeleton(), without(mesh, np.abs(mesh.vertices[:, 0]) > 0.26))


def test_the_file_of_joints_is_of_the_body_we_read() -> None:
    """The 2007 export is the same body: scaled and moved, vertex for vertex."""
    man, _ = makers_body()
    export = read_mesh(MESHES / "mh2007_male_T_dm.obj").vertices
    scale = np.ptp(export[:, 1]) / np.ptp(man[:, 1])
    np.testing.assert_allclose(export - export.mean(0), (man - man.mean(0)) * scale, atol=0.02)
