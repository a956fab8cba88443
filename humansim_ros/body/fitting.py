"""A mesh scaled, turned and moved to stand in the skeleton (thesis S1, chapter 4); limb joints moved into the
mesh.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from humansim_ros.body.mesh import Mesh
from humansim_ros.body.skeleton import Skeleton
from humansim_ros.errors import MeshError
from humansim_ros.rotations import Array

#: Slices of a standing person, as fractions of the height: where the ankles and the trunk are.
_ANKLES, _FEET = (0.03, 0.08), (0.0, 0.05)


def fit_to_skeleton(mesh: Mesh, skeleton: Skeleton) -> Mesh:
    """The mesh in body space (metres, y up, facing +z), as tall as the skeleton, soles at height 0, legs on
    its legs.

    The mesh must stand in a T or A pose, y up or z up, in any unit and anywhere. Raises MeshError where no
    person standing upright can be seen in it.
    """
    upright = mesh.vertices @ _upright(mesh.vertices).T
    low, high = upright[:, 1].min(), upright[:, 1].max()
    height = high - low
    scale = skeleton.tails[:, 1].max() / height
    fitted = (upright - np.array([0.0, low, 0.0])) * scale
    fitted[:, 0] -= (fitted[:, 0].min() + fitted[:, 0].max()) / 2
    ankles = [skeleton.bone("l_ankle"), skeleton.bone("r_ankle")]
    fitted[:, 2] += skeleton.heads[ankles][:, 2].mean() - _slice(fitted, *_ANKLES)[:, 2].mean()
    return replace(mesh, vertices=fitted)


def fit_limbs(skeleton: Skeleton, mesh: Mesh) -> Skeleton:
    """The skeleton with the joints of its legs and arms in the middle of the mesh's limbs; the trunk stays.

    ``mesh`` is one that :func:`fit_to_skeleton` made. The general skeleton stands with its legs together and
    its arms out; a mesh with its legs apart or its arms down would bend beside its joints. Raises MeshError
    if a limb is not where a person standing in a T or A pose has it.
    """
    heads, tails = skeleton.heads.copy(), skeleton.tails.copy()

    def move(bone: str, point: Array) -> None:
        index = skeleton.bone(bone)
        tails[index] += point - heads[index] if index in skeleton.leaves else 0.0
        heads[index] = point
        parent = skeleton.parents[index]
        if np.allclose(skeleton.tails[parent], skeleton.heads[index]):
            tails[parent] = point

    height = skeleton.tails[:, 1].max()
    for side, sign in (("l", 1.0), ("r", -1.0)):
        half = mesh.vertices[mesh.vertices[:, 0] * sign > 0]
        hip, knee, ankle = (
            skeleton.heads[skeleton.bone(f"{side}_{name}")] for name in ("hip", "knee", "ankle")
        )
        ankle_at = _section(
            half, np.array([hip[0], ankle[1], ankle[2]]), np.array([0.0, 1.0, 0.0]), 0.012 * height
        )
        legs = half[(half[:, 1] < hip[1]) & (np.abs(half[:, 0]) < 2.5 * max(abs(ankle_at[0]), abs(hip[0])))]
        knee_at = _section(legs, np.array([0.0, knee[1], 0.0]), np.array([0.0, 1.0, 0.0]), 0.012 * height)
        thigh_at = _section(
            legs, np.array([0.0, 0.9 * hip[1], 0.0]), np.array([0.0, 1.0, 0.0]), 0.012 * height
        )
        hip_at = np.array([hip[0], hip[1], thigh_at[2]])
        for name, point in (("hip", hip_at), ("knee", knee_at), ("ankle", ankle_at)):
            move(f"{side}_{name}", point)
        toes = half[(half[:, 1] < 0.05 * height)]
        tails[skeleton.bone(f"{side}_ankle")] = [
            ankle_at[0],
            skeleton.tails[skeleton.bone(f"{side}_ankle"), 1],
            toes[:, 2].max(),
        ]

        shoulder = skeleton.heads[skeleton.bone(f"{side}_shoulder")]
        tip = half[np.argmax(np.abs(half[:, 0]))]  # of the longest finger
        along = (tip - shoulder) / np.linalg.norm(tip - shoulder)
        reach = (half - shoulder) @ along
        arm = half[
            (reach > 0) & (np.linalg.norm(half - shoulder - reach[:, None] * along, axis=1) < 0.1 * height)
        ]
        length = np.linalg.norm(tip - shoulder)
        bones = [skeleton.lengths[skeleton.bone(f"{side}_{name}")] for name in ("shoulder", "elbow", "wrist")]
        shares = np.cumsum(bones) / np.sum(bones)
        elbow_at = _section(arm, shoulder + shares[0] * length * along, along, 0.012 * height)
        wrist_at = _section(arm, shoulder + shares[1] * length * along, along, 0.012 * height)
        upper_at = _section(arm, shoulder + 0.45 * shares[0] * length * along, along, 0.012 * height)
        axis = (elbow_at - upper_at) / (elbow_at - upper_at)[0]
        shoulder_at = upper_at + axis * (shoulder[0] - upper_at[0])
        for name, point in (("shoulder", shoulder_at), ("elbow", elbow_at), ("wrist", wrist_at)):
            move(f"{side}_{name}", point)
        tails[skeleton.bone(f"{side}_wrist")] = tip
    return replace(skeleton, heads=heads, tails=tails)


def _section(points: Array, at: Array, normal: Array, thickness: float) -> Array:
    """Middle of the cross-section of a limb: the box centre of the points within ``thickness`` of a plane."""
    near = points[np.abs((points - at) @ normal) < thickness]
    if len(near) < 4:
        raise MeshError(
            "no limb where a person in a T or A pose has one: stand the mesh upright, arms out or down"
        )
    return np.asarray((near.min(0) + near.max(0)) / 2)


def _slice(points: Array, low: float, high: float) -> Array:
    bottom, top = points[:, 1].min(), points[:, 1].max()
    height = (points[:, 1] - bottom) / (top - bottom)
    inside = (height >= low) & (height <= high)
    if not inside.any():
        raise MeshError("no feet at the lower end: the mesh is no person standing upright")
    return points[inside]


def _upright(vertices: Array) -> Array:
    """Rotation (3, 3), made of axis swaps, to y up, facing +z, x to the left."""
    extent = np.ptp(vertices, axis=0)
    if extent.min() <= 0:
        raise MeshError("the mesh is flat: it is no person")
    depth = int(np.argmin(extent))
    # of the two wide axes, the one the mesh is symmetric about is left-right: mirrored, the cloud keeps its
    # shape
    wide = [axis for axis in range(3) if axis != depth]
    side = min(wide, key=lambda axis: _asymmetry(vertices, axis))
    up = next(axis for axis in wide if axis != side)
    if up == 0:
        raise MeshError(
            "the mesh lies on its side (its height runs along x): turn it so that y or z points up"
        )
    upward = np.zeros(3)
    upward[up] = _up_sign(vertices, up)
    forward = np.zeros(3)
    forward[depth] = 1.0
    turn = np.stack([np.cross(upward, forward), upward, forward])
    feet = _slice(vertices @ turn.T, *_FEET)
    ankles = _slice(vertices @ turn.T, *_ANKLES)
    if feet[:, 2].max() - ankles[:, 2].mean() < ankles[:, 2].mean() - feet[:, 2].min():
        turn[[0, 2]] *= -1  # toes must point along +z
    return turn


def _asymmetry(vertices: Array, axis: int) -> float:
    """How much the outline changes when mirrored along an axis (mean difference of its profiles, of its
    extent).
    """
    centred = vertices - (vertices.min(0) + vertices.max(0)) / 2
    across = [a for a in range(3) if a != axis]
    height = np.ptp(centred, axis=0)
    total = 0.0
    for other in across:
        bins = np.minimum(((centred[:, other] / height[other] + 0.5) * 40).astype(int), 39)
        top, bottom = np.full(40, -np.inf), np.full(40, np.inf)
        np.maximum.at(top, bins, centred[:, axis])
        np.minimum.at(bottom, bins, centred[:, axis])
        seen = np.isfinite(top)
        total += float(np.abs(top[seen] + bottom[seen]).mean() / height[axis])
    return total


def _up_sign(vertices: Array, up: int) -> float:
    """Which way is up: the legs' end is narrower in total than the arms' end, so the widest height is above
    the middle.
    """
    side = [axis for axis in range(3) if axis != up]
    extent = np.ptp(vertices[:, side], axis=0)
    wide = side[int(np.argmax(extent))]
    far = np.abs(vertices[:, wide] - np.median(vertices[:, wide])) > 0.4 * extent.max()
    middle = (vertices[:, up].min() + vertices[:, up].max()) / 2
    return 1.0 if vertices[far, up].mean() > middle else -1.0
