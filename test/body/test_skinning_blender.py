"""Rest frames, posed frames and skinned vertices against Blender's armature (test/data/README.md)."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import ROOT
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from humansim_ros.body import Skeleton, hanim_skeleton, skin
from humansim_ros.types import Array

DATA = ROOT / "test" / "data"

with np.load(DATA / "blender_skinning.npz") as _archive:
    BLENDER = {key: _archive[key] for key in _archive}
with np.load(DATA / "blender_bodies.npz") as _archive:
    BODIES = {key: _archive[key] for key in _archive}
#: What Blender computes without and with "Preserve Volume".
BLENDERS_RESULT = {"linear": "skinned", "dual_quaternion": "preserved"}

#: Metres, and radians for directions.
TOLERANCE = 1e-6
#: Blender's float32 turns a bone about itself by up to this, radians, if it is within 10 degrees of -y.
ROLL_OF_BONES_POINTING_DOWN = 2e-5

both_sets = pytest.mark.parametrize("bones", ["straight", "rolled"])


def skeleton(rolls: Array) -> Skeleton:
    return Skeleton(
        names=tuple(BLENDER["names"].tolist()),
        parents=BLENDER["parents"],
        heads=BLENDER["heads"],
        tails=BLENDER["tails"],
        rolls=rolls,
    )


def turn_to_blender(ours: Skeleton, bones: str) -> Array:
    """Rotation vectors (B, 3) in bone space from our rest frames to Blender's."""
    difference = np.swapaxes(ours.rest[:, :3, :3], 1, 2) @ BLENDER[f"{bones}/rest"][:, :3, :3]
    return np.asarray(Rotation.from_matrix(difference).as_rotvec())


def blenders_skeleton(bones: str) -> Skeleton:
    """Our skeleton with the rolls that Blender gave to the bones."""
    rolls = BLENDER[f"{bones}/rolls"]
    return skeleton(rolls + turn_to_blender(skeleton(rolls), bones)[:, 1])


@both_sets
def test_rest_frames_agree_with_blender(bones: str) -> None:
    ours = skeleton(BLENDER[f"{bones}/rolls"])
    np.testing.assert_allclose(ours.rest[:, :3, 3], BLENDER[f"{bones}/rest"][:, :3, 3], atol=TOLERANCE)
    turn = np.abs(turn_to_blender(ours, bones))
    down = ours.rest[:, 1, 1] < -np.cos(np.radians(10))
    assert turn[~down].max() < TOLERANCE
    assert turn[down][:, [0, 2]].max() < TOLERANCE
    assert turn[down][:, 1].max() < ROLL_OF_BONES_POINTING_DOWN


@both_sets
def test_posed_frames_agree_with_blender(bones: str) -> None:
    posed = blenders_skeleton(bones).pose(BLENDER[f"{bones}/rotations"].astype(float))
    np.testing.assert_allclose(posed, BLENDER[f"{bones}/posed"], atol=TOLERANCE)


@both_sets
def test_skinned_vertices_agree_with_blender(bones: str) -> None:
    ours = blenders_skeleton(bones)
    transforms = ours.pose(BLENDER[f"{bones}/rotations"].astype(float)) @ np.linalg.inv(ours.rest)
    skinned = skin(BLENDER["vertices"].astype(float), csr_matrix(BLENDER["weights"]), transforms)
    assert np.linalg.norm(skinned - BLENDER[f"{bones}/skinned"], axis=-1).max() < TOLERANCE


@pytest.mark.parametrize("method", BLENDERS_RESULT)
@pytest.mark.parametrize("body", ["man", "artist", "straight", "rolled"])
def test_both_skinning_methods_agree_with_blender(body: str, method: str) -> None:
    data = BODIES if f"{body}/rest" in BODIES else BLENDER
    vertices = data.get(f"{body}/sample_vertices", BLENDER["vertices"]).astype(float)
    weights = csr_matrix(data.get(f"{body}/sample_weights", BLENDER["weights"]))
    transforms = data[f"{body}/posed"] @ np.linalg.inv(data[f"{body}/rest"].astype(float))
    skinned = skin(vertices, weights, transforms, method)
    off = np.linalg.norm(skinned - data[f"{body}/{BLENDERS_RESULT[method]}"], axis=-1)
    assert off.max() < TOLERANCE


def test_the_two_methods_differ_in_blender() -> None:
    for body in ("man", "artist"):
        apart = np.linalg.norm(BODIES[f"{body}/skinned"] - BODIES[f"{body}/preserved"], axis=-1)
        assert apart.max() > 0.01


def test_some_weights_do_not_sum_to_one() -> None:
    sums = BLENDER["weights"].sum(axis=1)
    assert sums.min() < 0.5
    assert sums.max() > 1.5


def test_the_general_skeleton_is_the_one_that_blender_was_given() -> None:
    ours = hanim_skeleton()
    order = [ours.names.index(name) for name in BLENDER["names"]]
    assert len(ours.names) == len(order) == 22
    np.testing.assert_array_equal(ours.heads[order], BLENDER["heads"])
    np.testing.assert_array_equal(ours.tails[order], BLENDER["tails"])
    np.testing.assert_array_equal(ours.rolls[order], BLENDER["straight/rolls"])
    parents = [ours.names[ours.parents[bone]] if ours.parents[bone] >= 0 else None for bone in order]
    expected = [BLENDER["names"][parent] if parent >= 0 else None for parent in BLENDER["parents"]]
    assert parents == expected
