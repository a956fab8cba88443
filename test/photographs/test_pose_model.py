"""Keypoints as a function of pose and proportions: the bodies that they describe, and derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from humansim_ros.people import KEYPOINT_SETS, KeypointLocator, keypoint_set, load_human
from humansim_ros.photographs.person_fit import with_proportions
from humansim_ros.photographs.pose_model import BodyState, PoseModel


def some_state(model: PoseModel, seed: int = 0) -> BodyState:
    rng = np.random.default_rng(seed)
    return model.moved(model.neutral(), rng.normal(0, 0.25, model.size))


@pytest.mark.daily("coco17", "mediapipe33", "plug_in_gait", "smpl24", "wholebody133")
@pytest.mark.parametrize("name", sorted(KEYPOINT_SETS))
def test_keypoints_are_those_of_the_posed_body(name: str) -> None:
    human = load_human("adult_man")
    model = PoseModel(human, keypoint_set(name))
    state = some_state(model)
    body = with_proportions(human, model.proportions(state))
    posed = body.skeleton.pose(model.rotations(state), model.root(state, body.skeleton))
    joints = body.skeleton.joint_transforms(posed)[:, :3, 3]
    # the keypoints of the skin keep their place on the mesh
    locator = KeypointLocator.of(human, keypoint_set(name))
    expected = locator.positions(joints, body.pose(posed))
    errors = np.linalg.norm(model.keypoints(state) - expected, axis=1)
    # skin between bones blends their scales, and then their poses
    assert (errors < np.where(locator.on_surface, 5e-3, 1e-6)).all(), errors
    same = replace(state, stature=0.0, lengths=0 * state.lengths, girths=0 * state.girths)
    posed = human.skeleton.pose(model.rotations(same), model.root(same, human.skeleton))
    joints = human.skeleton.joint_transforms(posed)[:, :3, 3]
    np.testing.assert_allclose(model.keypoints(same), locator.positions(joints, human.pose(posed)), atol=2e-6)


def test_derivatives_are_those_of_differences() -> None:
    model = PoseModel(load_human("adult_woman").without_details(), keypoint_set("body25"))
    state = some_state(model, 1)
    positions, slopes = model.derivatives(state)
    np.testing.assert_allclose(positions, model.keypoints(state))
    for number in range(model.size):
        step = np.zeros(model.size)
        step[number] = 1e-6
        after, before = (model.keypoints(model.moved(state, sign * step)) for sign in (1, -1))
        np.testing.assert_allclose(
            slopes[:, :, number], (after - before) / 2e-6, atol=2e-8, err_msg=str(number)
        )


def test_left_and_right_have_one_length() -> None:
    model = PoseModel(load_human("child").without_details(), keypoint_set("coco17"))
    for left, right in (("l_knee", "r_knee"), ("l_shoulder", "r_shoulder"), ("l_ankle", "r_ankle")):
        groups = [model.group_of[model.skeleton.bone(name)] for name in (left, right)]
        assert groups[0] == groups[1]
    assert len(model.groups) < len(model.skeleton)
