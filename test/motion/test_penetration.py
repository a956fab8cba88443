"""Self-penetration: distances against least squares, bodies against their own posed meshes."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from functools import cache

import numpy as np
import pytest
import trimesh
from capsules import Capsules, fit_capsules, report_penetration, segment_distance, self_penetration
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from test_retarget import in_world, read

from humansim_ros.errors import MeshError
from humansim_ros.motion import Skeleton, hanim_skeleton
from humansim_ros.motion.body.skinning import dominant_bones, without_details
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.loading import load_human
from humansim_ros.types import Array


@cache
def man() -> Human:
    return load_human(ROOT / "assets" / "humans" / "adult_man.npz")


@cache
def man_capsules() -> Capsules:
    return fit_capsules(man().skeleton, man().mesh, man().weights)


def turned(skeleton: Skeleton, turns: dict[str, Rotation]) -> Array:
    """Posed bones (1, B, 4, 4) with some rotated about body axes (x left, y up, z front) from rest."""
    rotations = np.tile([0.0, 0, 0, 1], (1, len(skeleton), 1))
    for name, turn in turns.items():
        bone = skeleton.bone(name)
        rest = Rotation.from_matrix(skeleton.rest[bone, :3, :3])
        rotations[0, bone] = (rest.inv() * turn * rest).as_quat()
    return skeleton.pose(rotations)


def by_least_squares(a: Array, b: Array, c: Array, d: Array) -> float:
    """Distance of two segments as a bounded quadratic problem in the positions along them."""
    columns = np.stack([b - a, c - d], axis=1)
    return float(np.sqrt(2 * lsq_linear(columns, c - a, bounds=(0, 1), method="bvls").cost))


points = st.lists(st.integers(-4, 4).map(float), min_size=12, max_size=12).map(
    lambda v: np.reshape(v, (4, 3))
)


@given(ends=points, noise=st.booleans(), seed=st.integers(0, 1000))
def test_segment_distance_is_that_of_least_squares(ends: Array, noise: bool, seed: int) -> None:
    """On a coarse grid, where many are parallel, crossing, collinear or points; and off it."""
    if noise:
        ends = ends + np.random.default_rng(seed).normal(size=(4, 3)) * 1e-3
    assert segment_distance(*ends) == pytest.approx(by_least_squares(*ends), abs=1e-6)
    assert segment_distance(*ends[[2, 3, 0, 1]]) == pytest.approx(segment_distance(*ends), abs=1e-9)


def test_depths_are_those_of_each_pair_of_capsules_alone() -> None:
    body = man_capsules()
    rng = np.random.default_rng(2)
    posed = body.skeleton.pose(Rotation.random(3 * len(body.skeleton), rng).as_quat().reshape(3, -1, 4))
    found = self_penetration(posed, body)
    for frame in range(3):
        frames = posed[frame, body.bones]
        starts, ends = (
            np.einsum("cij,cj->ci", frames[:, :3, :3], p) + frames[:, :3, 3] for p in (body.starts, body.ends)
        )
        for pair, bones in enumerate(body.pairs):
            first, second = (np.flatnonzero(body.bones == bone) for bone in bones)
            depth = max(
                body.radii[i] + body.radii[j] - by_least_squares(starts[i], ends[i], starts[j], ends[j])
                for i in first
                for j in second
            )
            assert found[frame, pair] == pytest.approx(depth, abs=1e-6)


def test_a_batch_of_poses_equals_single_poses() -> None:
    body = man_capsules()
    posed = body.skeleton.pose(Rotation.random(400 * len(body.skeleton), 1).as_quat().reshape(400, -1, 4))
    whole = self_penetration(posed, body)
    for frame in (0, 144, 145, 399):
        np.testing.assert_allclose(self_penetration(posed[[frame]], body)[0], whole[frame], atol=1e-12)


def test_an_arm_through_the_chest_is_reported_with_its_depth() -> None:
    """Through the middle of the trunk: half its thickness and that of the forearm."""
    body = man_capsules()
    turn = Rotation.from_euler("z", 20, degrees=True) * Rotation.from_euler("y", 180, degrees=True)
    through, still = turned(body.skeleton, {"l_shoulder": turn}), body.skeleton.rest[None]
    report = report_penetration(np.concatenate([still, through, still, still]), body)
    assert (report.pair, report.frame, report.share) == (("vl5", "l_elbow"), 1, 0.25)
    assert report.pairs[0] == ("vl5", "l_elbow", report.depth_mm, 0.25)
    radii = {body.skeleton.names[b]: r for b, r in zip(body.bones, body.radii, strict=True)}
    assert 0.75 < report.depth_mm / 1e3 / (radii["vl5"] + radii["l_elbow"]) <= 1
    json.dumps(asdict(report), allow_nan=False)


def hull_depth(a: Array, b: Array) -> float:
    """Distance to separate the convex hulls of two clouds along a face normal."""
    first, second = ConvexHull(a), ConvexHull(b)
    normals = np.concatenate([first.equations[:, :3], -second.equations[:, :3]])
    over = (a[first.vertices] @ normals.T).max(0) - (b[second.vertices] @ normals.T).min(0)
    return float(over.min())


@pytest.mark.nightly
@pytest.mark.slow
def test_penetration_of_limbs_agrees_with_the_hulls_of_their_meshes() -> None:
    """Without the two thighs, whose meshes meet between the legs."""
    body, owner = man_capsules(), dominant_bones(without_details(man().weights, man().skeleton))
    trunk = ("HumanoidRoot", "sacroiliac", "vl5")
    held = np.array([a not in trunk and (a, b) != ("l_hip", "r_hip") for a, b in body.pair_names])
    rng = np.random.default_rng(7)
    errors = []
    while len(errors) < 80:
        turns = {
            name: Rotation.from_rotvec(rng.normal(size=3) * 0.7)
            for name in ("l_hip", "r_hip", "l_knee", "r_knee", "l_shoulder", "r_shoulder", "l_elbow")
        }
        posed = turned(body.skeleton, turns)
        vertices = np.asarray(man().pose(posed[0]), float)
        depths = self_penetration(posed, body)[0]
        for pair in np.flatnonzero(held & (np.abs(depths) < 0.06)):
            first, second = (vertices[owner == bone] for bone in body.pairs[pair])
            depth = hull_depth(first, second)
            if max(depth, depths[pair]) > 0:
                errors.append(max(depths[pair], 0) - max(depth, 0))
    assert np.median(np.abs(errors)) < 0.02
    assert np.abs(np.mean(errors)) < 0.01


@pytest.mark.nightly
@pytest.mark.slow
def test_a_hand_penetrates_the_trunk_when_rays_say_so() -> None:
    """The left arm moves through the body; ray casting gives the depth of the hand inside the mesh."""
    body, owner = man_capsules(), dominant_bones(without_details(man().weights, man().skeleton))
    skeleton, triangles = man().skeleton, man().mesh.triangles
    arm = [skeleton.bone(name) for name in ("l_shoulder", "l_elbow", "l_wrist")]
    others = triangles[~np.isin(owner[triangles], arm).all(1)]
    hand = np.flatnonzero(owner == arm[2])[::14]
    trunk = [p for p, (a, b) in enumerate(body.pair_names) if b == "l_wrist" and a in ("vl5", "sacroiliac")]
    seen = []
    for angle in (-120, -135, -140, -145, -150, -160):
        turns = {
            "l_shoulder": Rotation.from_euler("yx", [-40, 15], degrees=True),
            "l_elbow": Rotation.from_euler("y", angle, degrees=True),
        }
        posed = turned(skeleton, turns)
        vertices = np.asarray(man().pose(posed[0]), float)
        rest = trimesh.Trimesh(vertices, others, process=False)
        # out to the back: away from the hole where the arm was
        rays = np.tile([0.05, 0.03, -1.0], (len(hand), 1))
        _, ray, _ = rest.ray.intersects_location(vertices[hand], rays, multiple_hits=True)
        inside = np.bincount(ray, minlength=len(hand)) % 2 == 1
        depth = 0.0
        if inside.any():
            depth = float(trimesh.proximity.closest_point_naive(rest, vertices[hand][inside])[1].max())
        seen.append((self_penetration(posed, body)[0, trunk].max(), depth))
    ours, theirs = np.array(seen).T
    assert theirs[0] == 0 and theirs[-1] > 0.05, seen  # from outside to deep inside
    assert ours[0] < 0.01
    assert (ours[theirs > 0.03] > 0).all() and (theirs[ours > 0.03] > 0).all(), seen


def test_standing_and_walking_are_clean() -> None:
    body = man_capsules()
    down = {"l_shoulder": Rotation.from_euler("z", -75, degrees=True)}
    down["r_shoulder"] = down["l_shoulder"].inv()
    assert self_penetration(turned(body.skeleton, down), body).max() < 0.02
    world = in_world(read("walk"))
    walking = Retargeter.fit(world, body.skeleton).pose(world.sample(world.frame_times))
    report = report_penetration(walking, body)
    assert (report.share, report.pairs) == (0.0, ())


def test_joined_bones_and_bones_that_touch_at_rest_are_not_pairs() -> None:
    for body in (man_capsules(), fit_capsules(hanim_skeleton())):
        pairs = set(body.pair_names)
        assert self_penetration(body.skeleton.rest[None], body).max() <= 0
        assert not pairs & {("vl5", "l_shoulder"), ("HumanoidRoot", "l_hip"), ("l_hip", "l_knee")}
        assert not any("sternoclavicular" in a + b for a, b in pairs)
        assert pairs >= {("vl5", "l_wrist"), ("l_wrist", "r_wrist"), ("l_hip", "r_wrist"), ("vt3", "r_wrist")}


def test_an_average_man_fits_the_skeleton_of_one() -> None:
    measured, usual = man_capsules(), fit_capsules(man().skeleton)
    np.testing.assert_array_equal(measured.bones, usual.bones)
    np.testing.assert_allclose(usual.radii, measured.radii, atol=0.005)


def test_a_skeleton_with_unknown_bones_is_an_error() -> None:
    strangers = replace(hanim_skeleton(), names=tuple(f"bone{i}" for i in range(22)))
    with pytest.raises(MeshError, match="no bone of this skeleton"):
        fit_capsules(strangers)
