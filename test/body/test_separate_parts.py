"""Bodies whose parts do not touch: floating arms and hands, swords, hats, and parts far away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from humansim_ros import load_human
from humansim_ros.errors import HumansimWarning, MeshError
from humansim_ros.files.mesh.mesh import Mesh, padded
from humansim_ros.motion.body.skinning import dominant_bones, without_details
from humansim_ros.people.humans.human import Human
from humansim_ros.people.rigging.fitting import fit_skeleton, rig

Array = NDArray[np.float64]
ARM = ("shoulder", "elbow", "wrist")


@pytest.fixture(scope="module")
def child() -> Human:
    return load_human("child")


def with_floating(human: Human, bones: tuple[str, ...], gap: float) -> tuple[Mesh, dict[str, Array]]:
    """The mesh with these parts of both sides moved outwards, cut from the rest; and how they moved."""
    human = human.without_details()
    names, dominant = human.skeleton.names, dominant_bones(human.weights)
    vertices, triangles = human.mesh.vertices.copy(), human.mesh.triangles
    moves, kept = {}, np.ones(len(triangles), dtype=bool)
    for side in "lr":
        ours = [names.index(f"{side}_{bone}") for bone in bones]
        along = human.skeleton.tails[ours[-1]] - human.skeleton.heads[ours[0]]
        moved = np.isin(dominant, ours)
        vertices[moved] += gap * along / np.linalg.norm(along)
        moves[side] = gap * along / np.linalg.norm(along)
        within = moved[triangles].sum(axis=1)
        kept &= (within == 0) | (within == 3)
    return Mesh(vertices, padded(triangles[kept])), moves


def with_box(mesh: Mesh, center: tuple[float, float, float], half: tuple[float, float, float]) -> Mesh:
    """The mesh and a box of 8 vertices."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half + center
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = np.concatenate([padded(mesh.triangles), np.array(quads, np.int32) + len(mesh.vertices)])
    return Mesh(np.concatenate([mesh.vertices, corners]), faces.astype(np.int32))


def stature(mesh: Mesh) -> float:
    return float(np.ptp(mesh.vertices[:, 1]))


@pytest.mark.daily("hands")
@pytest.mark.slow
@pytest.mark.parametrize("bones", [ARM, ("wrist",)], ids=["arms", "hands"])
def test_floating_limbs_are_rigged_to_their_bones_with_a_warning(
    child: Human, bones: tuple[str, ...]
) -> None:
    mesh, moves = with_floating(child, bones, 0.04)
    with pytest.warns(HumansimWarning, match="2 parts of the body are separate.*look at the result"):
        fitted, skeleton = fit_skeleton(mesh, up="y", facing="z", stature=stature(mesh))
    shift = fitted.vertices[0] - mesh.vertices[0]
    truth = child.skeleton
    for side, move in moves.items():
        for bone in bones:
            joint = truth.heads[truth.bone(f"{side}_{bone}")] + move + shift
            found = skeleton.heads[skeleton.bone(f"{side}_{bone}")]
            assert np.linalg.norm(found - joint) < 0.06 * stature(mesh), bone
    weights = rig(fitted, skeleton)
    names = np.array(skeleton.names)
    used = np.unique(fitted.faces[fitted.faces >= 0])
    wanted = np.array(truth.names)[dominant_bones(child.weights)][used]
    got = names[dominant_bones(weights)][used]
    for side in "lr":
        for bone in bones:
            part = wanted == f"{side}_{bone}"
            assert (got[part] == f"{side}_{bone}").mean() > 0.7, bone


@pytest.mark.nightly
@pytest.mark.slow
def test_a_floating_head_leaves_the_joints_where_they_are(child: Human) -> None:
    child = child.without_details()
    names, vertices = child.skeleton.names, child.mesh.vertices.copy()
    head, triangles = dominant_bones(child.weights) == names.index("vt3"), child.mesh.triangles
    vertices[head, 1] += 0.05
    within = head[triangles].sum(axis=1)
    mesh = Mesh(vertices, padded(triangles[(within == 0) | (within == 3)]))
    with pytest.warns(HumansimWarning, match="a part of the body is separate"):
        fitted, skeleton = fit_skeleton(mesh, up="y", facing="z", stature=stature(mesh))
    truth = child.skeleton.heads + fitted.vertices[0] - mesh.vertices[0]
    assert np.linalg.norm(skeleton.heads - truth, axis=1).max() < 0.05 * stature(mesh)
    used = np.unique(mesh.faces[mesh.faces >= 0])
    got = np.array(skeleton.names)[dominant_bones(rig(fitted, skeleton))]
    assert (got[used][head[used]] == "vt3").mean() > 0.95


@pytest.mark.nightly
@pytest.mark.slow
def test_a_sword_beside_the_hand_does_not_lengthen_the_arm_and_stays_rigid(child: Human) -> None:
    hand = child.skeleton.tails[child.skeleton.bone("r_wrist")]
    sword = with_box(child.mesh, (hand[0] - 0.1, hand[1] - 0.15, hand[2]), (0.02, 0.25, 0.01))
    plain, alone = fit_skeleton(child.mesh, up="y", facing="z", stature=1.3)
    fitted, skeleton = fit_skeleton(sword, up="y", facing="z", stature=1.3)
    np.testing.assert_allclose(skeleton.heads, alone.heads, atol=0.02)
    weights = rig(fitted, skeleton)[len(plain.vertices) :].toarray()
    assert np.ptp(weights, axis=0).max() < 1e-9
    assert skeleton.names[weights[0].argmax()] == "r_wrist"


@pytest.mark.slow
def test_a_sleeve_of_few_vertices_bends_with_its_arm(child: Human) -> None:
    elbow = child.skeleton.heads[child.skeleton.bone("l_elbow")]
    shoulder = child.skeleton.heads[child.skeleton.bone("l_shoulder")]
    wrist = child.skeleton.heads[child.skeleton.bone("l_wrist")]
    rings = [shoulder + t * (elbow - shoulder) for t in (0.1, 0.5, 0.9)]
    rings += [elbow + t * (wrist - elbow) for t in (0.1, 0.5, 0.95)]
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    along = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
    side = np.cross(along, [0.0, 0.0, 1.0])
    circle = 0.05 * (np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.array([0.0, 0.0, 1.0]))
    points = np.concatenate([ring + circle for ring in rings])
    quads = np.array(
        [[12 * r + i, 12 * r + (i + 1) % 12, 12 * r + 12 + (i + 1) % 12, 12 * r + 12 + i]
         for r in range(len(rings) - 1) for i in range(12)]
    )  # fmt: skip
    count = len(child.mesh.vertices)
    faces = np.concatenate([padded(child.mesh.triangles), quads + count]).astype(np.int32)
    mesh = Mesh(np.concatenate([child.mesh.vertices, points]), faces)
    names = np.array(child.skeleton.names)
    got = names[dominant_bones(rig(mesh, child.skeleton))][count:]
    assert (got[:12] == "l_shoulder").all()
    assert (got[-12:] == "l_elbow").all()


@pytest.mark.parametrize("scale", [1.0, 100.0])
def test_a_part_far_from_the_body_is_refused_with_its_place_and_size(child: Human, scale: float) -> None:
    mesh = with_box(child.mesh, (1.9, 0.7, 0.1), (0.05, 0.05, 0.05))
    mesh = replace(mesh, vertices=scale * mesh.vertices)
    place = rf"a part of 8 vertices around \({scale * 1.9:.3g}, {scale * 0.7:.3g}, {scale * 0.1:.3g}\) is"
    with pytest.raises(MeshError, match=place + " too far from every bone.*Delete the part"):
        fit_skeleton(mesh, up="y", facing="z")


def test_a_body_without_arms_is_refused_although_parts_float_beside_it(child: Human) -> None:
    mesh, _ = with_floating(child, ARM, 0.0)
    names = child.skeleton.names
    arms = [names.index(f"{side}_{bone}") for side in "lr" for bone in ARM]
    weights = without_details(child.weights, child.skeleton)
    gone = np.isin(dominant_bones(weights), arms)[mesh.triangles].any(axis=1)
    body = with_box(Mesh(mesh.vertices, padded(mesh.triangles[~gone])), (0.25, 0.9, 0.0), (0.02,) * 3)
    with pytest.raises(MeshError, match=r"arm|limb"):
        fit_skeleton(body, up="y", facing="z")
