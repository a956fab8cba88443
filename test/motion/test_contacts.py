"""Foot contacts: detected, measured and pinned."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import if_shared
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from test_retarget import SHARED, SKELETON, in_world, read

from humansim_ros.motion.body.skeleton import sole_heights, sole_points
from humansim_ros.motion.pose.contacts import (
    FootContacts,
    SkinContact,
    find_stances,
    slide_distances,
    two_bone,
)
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.motion.pose.world_motion import Placement, WorldMotion
from humansim_ros.scene import Scene
from humansim_ros.scene.core.actor import Actor
from humansim_ros.types import Array

stems = pytest.mark.parametrize("stem", ["walk", "own_mixamo", "own_z_up", "own_cmu", *if_shared(*SHARED)])
point = st.tuples(*[st.floats(-0.5, 0.5)] * 3).map(np.array)


def pinned(world: WorldMotion) -> tuple[WorldMotion, Retargeter]:
    retargeter = Retargeter.fit(world, SKELETON)
    return replace(world, correction=FootContacts.detect(world, retargeter)), retargeter


@pytest.mark.slow
@stems
def test_pinned_feet_stay_on_the_floor_where_they_stand(stem: str) -> None:
    """The lowest point of the sole moves 2 mm at most in the stances of the uncorrected motion."""
    world = in_world(read(stem))
    clean, retargeter = pinned(world)
    times = world.frame_times[:1500]
    before, after = retargeter.pose(world.sample(times)), retargeter.pose(clean.sample(times))
    stances = find_stances(SKELETON, before, times)
    assert stances
    assert np.median(slide_distances(SKELETON, after, stances)) < 0.002
    assert (
        slide_distances(SKELETON, after, stances).mean()
        < 0.15 * slide_distances(SKELETON, before, stances).mean()
    )
    for stance in stances:
        lowest = sole_points(SKELETON, after)[stance.first : stance.last + 1, stance.foot, :, 2].min(-1)
        assert np.median(np.abs(lowest)) < 0.012, stance


@pytest.mark.slow
@stems
def test_only_legs_and_height_change_and_feet_keep_their_orientation(stem: str) -> None:
    world = in_world(read(stem))
    clean, retargeter = pinned(world)
    times = world.frame_times[::9][:100]
    plain, changed = world.sample(times), clean.sample(times)
    before, after = retargeter.pose(plain), retargeter.pose(changed)
    legs = [SKELETON.bone(f"{side}_{part}") for side in "lr" for part in ("hip", "knee")]
    others = [bone for bone in range(len(SKELETON)) if bone not in legs]
    np.testing.assert_allclose(after[:, others, :3, :3], before[:, others, :3, :3], atol=1e-6)
    lower = (after - before)[:, 0, :3, 3]
    assert np.abs(lower[:, :2]).max() < 1e-9
    assert -0.16 < lower[:, 2].min() <= lower[:, 2].max() < 1e-9
    # the source's own links keep their lengths: it is still the same person
    parents = world.motion.parents
    children = np.flatnonzero(parents >= 0)
    length_before, length_after = (
        np.linalg.norm(p.positions[:, children] - p.positions[:, parents[children]], axis=-1)
        for p in (plain, changed)
    )
    np.testing.assert_allclose(length_after, length_before, atol=1e-6)


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("loop", ["repeat", "continue"])
def test_a_stance_across_the_end_of_a_loop_is_pinned(loop: Any, mirror: bool) -> None:
    world = replace(in_world(read("walk"), loop, Placement((1.0, 2.0), 0.5)), mirror=mirror)
    clean, retargeter = pinned(world)
    times = np.arange(0, 3 * world.duration, 1 / 60)
    before, after = (retargeter.pose(w.sample(times)) for w in (world, clean))
    inside = [s for s in find_stances(SKELETON, before, times) if s.last < len(times) - 1 and s.first > 0]
    assert len(inside) >= (10 if loop == "continue" else 8)
    assert slide_distances(SKELETON, after, inside).max() < (0.004 if loop == "continue" else 0.012)
    if loop == "continue":
        steps = np.linalg.norm(np.diff(sole_points(SKELETON, after), axis=0), axis=-1)
        assert steps.max() < 0.11  # 6 m/s of a swinging foot: no jumps


def test_pinned_poses_do_not_depend_on_earlier_samples() -> None:
    clean, _ = pinned(in_world(read("walk"), "continue"))
    later = clean.sample([3.3]).positions
    clean.sample([0.1, 7.0])
    np.testing.assert_array_equal(clean.sample([3.3]).positions, later)
    np.testing.assert_allclose(clean.sample([0.2, 3.3]).positions[1], later[0], atol=1e-12)


def test_velocities_are_those_of_the_pinned_joints() -> None:
    clean, _ = pinned(in_world(read("walk"), "continue"))
    poses = clean.sample_with_velocities(0.63)
    around = clean.sample(0.63 + np.linspace(-1e-3, 1e-3, 21)).positions.reshape(21, -1)
    slope = np.polyfit(np.linspace(-1e-3, 1e-3, 21), around, 1)[0].reshape(-1, 3)
    assert poses.linear is not None
    np.testing.assert_allclose(poses.linear[0], slope, atol=0.02)


def test_a_person_that_slides_without_steps_is_corrected_by_25_cm_at_most() -> None:
    """All joints move at 0.3 m/s: to stand, the feet would have to stay behind, but by 25 cm at most."""
    walk = read("walk")
    values = np.zeros((61, walk.values.shape[1]))
    columns = [f"{n}{c}" for n, names in zip(walk.joint_names, walk.channels, strict=True) for c in names]
    values[:, columns.index("HipsYposition")] = walk.offsets[0, 1] or 95.0
    values[:, columns.index("HipsZposition")] = np.arange(61) * 0.5
    world = in_world(replace(walk, values=values, frame_time=1 / 60))
    clean, retargeter = pinned(world)
    after = retargeter.pose(clean.sample(world.frame_times))
    toes = sole_points(SKELETON, after)[:, :, 0]
    assert np.ptp(toes[..., 0]) < 0.02
    assert sole_heights(SKELETON, after).min() > -0.01


@settings(max_examples=200, deadline=None)
@given(hip=point, thigh=point, shin=point, move=point)
def test_two_bones_reach_their_goal_and_keep_their_lengths(
    hip: Array, thigh: Array, shin: Array, move: Array
) -> None:
    lengths = np.linalg.norm(thigh), np.linalg.norm(shin)
    leg = np.linalg.norm(thigh + shin)
    if (
        min(lengths) < 0.05
        or not 0.05 < leg < 0.999 * sum(lengths)
        or leg < 1.1 * abs(lengths[0] - lengths[1])
    ):
        return
    knee, ankle = hip + thigh, hip + thigh + shin
    goal = ankle + move
    reach = np.linalg.norm(goal - hip)
    opposite = (goal - hip) @ (ankle - hip) < -0.99 * reach * leg
    if opposite or reach < 0.05:
        return
    upper, lower = two_bone(*(p[None] for p in (hip, knee, ankle, goal)))
    new_knee = hip + upper[0] @ thigh
    new_ankle = new_knee + lower[0] @ shin
    for turn in (upper[0], lower[0]):
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-7)
        assert np.linalg.det(turn) > 0
    if 1.01 * abs(lengths[0] - lengths[1]) < reach < 0.999 * sum(lengths):
        np.testing.assert_allclose(new_ankle, goal, atol=1e-6)
    else:
        cosine = (new_ankle - hip) @ (goal - hip) / np.linalg.norm(new_ankle - hip) / reach
        assert cosine > 1 - 1e-6
    # the hinge rotates with the leg: it stays perpendicular to the plane of the leg
    hinge = np.cross(thigh, shin)
    if np.linalg.norm(hinge) > 1e-3:
        carried = upper[0] @ hinge / np.linalg.norm(hinge)
        np.testing.assert_allclose(carried, lower[0] @ hinge / np.linalg.norm(hinge), atol=1e-6)
        assert abs(carried @ (new_ankle - hip)) < 1e-6


def test_a_goal_at_the_ankle_moves_nothing() -> None:
    rng = np.random.default_rng(5)
    points = rng.normal(size=(3, 20, 3))
    upper, lower = two_bone(points[0], points[1], points[2], points[2])
    for turns in (upper, lower):
        assert Rotation.from_matrix(turns).magnitude().max() < 1e-6


# --- skin on the floor


def lying(motion: str, body: str, **keys: Any) -> Actor:
    loop = "continue" if motion == "crawl" else "repeat"
    humans = {"anna": {"body": body, "motion": {"file": motion, "loop": loop, **keys}}}
    cameras = {"front": {"position": [4, 0, 1], "look_at": [0, 0, 0.5]}}
    return Scene.from_dict({"humans": humans, "cameras": cameras, "room": None}).actors["anna"]


@pytest.mark.daily("lie-adult_woman", "fall-child")
@pytest.mark.slow
@pytest.mark.parametrize("body", ["adult_man", "adult_woman", "child", "tall_heavy_man", "slim_old_woman"])
@pytest.mark.parametrize("motion", ["lie", "fall", "crawl"])
def test_the_skin_of_who_lies_is_on_the_floor(motion: str, body: str) -> None:
    actor = lying(motion, body)
    lowest = [
        float(actor.at(time).vertices[:, 2].min())
        for time in np.arange(0.03, min(actor.motion.duration, 9.0), 0.23)
    ]
    assert min(lowest) > -0.01 and max(lowest) < 0.02
    velocity = actor.at(2.0).linear
    assert velocity is not None and np.isfinite(velocity).all()


@pytest.mark.nightly
@pytest.mark.parametrize("number", range(1, 6))
def test_the_body_of_who_lies_is_on_the_floor_below_skirts(number: int) -> None:
    actor = lying("lie", f"person#{number}-1")
    vertices = actor.at(2.0).vertices
    assert -0.01 < float(vertices[:, 2].min()) < 0.02
    # the trunk and the head are near it, and nothing stands in the air
    assert float(np.percentile(vertices[:, 2], 5)) < 0.08


def test_a_recording_is_placed_by_its_skin_if_the_scene_says_so() -> None:
    soles, skin = (lying("sit", "child", floor=floor) for floor in ("soles", "skin"))
    assert soles.motion.correction is None
    moved = skin.at(1.0).positions - soles.at(1.0).positions
    np.testing.assert_allclose(moved, np.broadcast_to(moved[0] * (0, 0, 1), moved.shape), atol=1e-9)
    assert float(skin.at(1.0).vertices[:, 2].min()) == pytest.approx(0, abs=0.003)
    # what pins the feet is kept
    both = lying("crawl", "child", pin_feet=True, yaw_deg=90).motion.correction
    assert isinstance(both, SkinContact) and isinstance(both.before, FootContacts)
