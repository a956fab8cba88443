"""Keypoints lie where anatomy says, on the built-in humans and on other bodies."""

from __future__ import annotations

import numpy as np
import pytest

from humansim_ros import Human, load_human
from humansim_ros.cli.human import built_in_humans
from humansim_ros.keypoints import KEYPOINT_SETS, KeypointLocator, keypoint_set
from humansim_ros.types import Array

PEOPLE = built_in_humans()


def rest_joints(human: Human) -> Array:
    """Joints (J, 3) of a human at rest."""
    return human.skeleton.joint_transforms(human.skeleton.rest)[:, :3, 3]


def located(human: Human, name: str) -> dict[str, Array]:
    """Keypoints (3,) of a set by name on a human at rest: y up, facing +z, +x is the person's left."""
    keypoints = keypoint_set(name)
    positions = KeypointLocator.of(human, keypoints).positions(rest_joints(human), human.mesh.vertices)
    return dict(zip(keypoints.names, positions, strict=True))


@pytest.mark.parametrize("body", PEOPLE)
def test_coco_faces_have_their_parts_in_the_right_order(body: str) -> None:
    at = located(load_human(body), "coco17")
    # from the ears at the back to the nose in front; the eyes above the nose
    assert at["nose"][2] > at["left_eye"][2] > at["left_ear"][2] + 0.04
    assert at["left_eye"][1] > at["nose"][1] + 0.015
    assert abs(at["nose"][0]) < 0.002
    assert 0.05 < at["left_eye"][0] - at["right_eye"][0] < 0.075  # between the pupils
    # hair covers the ears of the adult woman
    assert 0.12 < at["left_ear"][0] - at["right_ear"][0] < (0.18 if body == "adult_woman" else 0.16)


@pytest.mark.parametrize("body", PEOPLE)
@pytest.mark.parametrize("name", KEYPOINT_SETS)
def test_left_is_the_mirror_image_of_right(name: str, body: str) -> None:
    at = located(load_human(body), name)
    pairs = [(key, key.replace("left", "right")) for key in at if "left" in key]
    assert pairs
    for left, right in pairs:
        assert at[left][0] > 0.005
        np.testing.assert_allclose(at[left] * [-1, 1, 1], at[right], atol=0.002, err_msg=left)


def test_a_locator_is_made_once_for_a_human_and_forgotten_with_it() -> None:
    human, keypoints = load_human("child"), keypoint_set("coco17")
    known = len(KeypointLocator._known)
    assert KeypointLocator.of(human, keypoints) is KeypointLocator.of(human, keypoints)
    assert len(KeypointLocator._known) == known + 1
    del human
    assert len(KeypointLocator._known) == known
