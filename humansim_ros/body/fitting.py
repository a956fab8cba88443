"""A mesh scaled, turned and moved to stand in the skeleton (thesis S1, chapter 4); limb joints moved into the
mesh.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from humansim_ros.body.mesh import Mesh
from humansim_ros.body.skeleton import Skeleton
from humansim_ros.errors import MeshError
from humansim_ros.rotations import Array

#: Slices of a standing person, as fractions of the height: where the ankles and the trunk are.
_ANKLES, _FEET = (0.03, 0.08), (0.0, 0.05)
#: Height of the hip joints as a fraction of the height (Drillis and Contini, 1966). The general skeleton has
#: them lower, where the legs part: a thigh that turned there would fold in the middle.
_HIPS = 0.53
_NO_LIMB = "no limb where a person in a T or A pose has one: stand the mesh upright, arms out or down"


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
    ways = _ways_along_skin(mesh, 0.02 * height)
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
        hip_at = np.array([hip[0], _HIPS * height, thigh_at[2]])
        for name, point in (("hip", hip_at), ("knee", knee_at), ("ankle", ankle_at)):
            move(f"{side}_{name}", point)
        toes = half[(half[:, 1] < 0.05 * height)]
        tails[skeleton.bone(f"{side}_ankle")] = [
            ankle_at[0],
            skeleton.tails[skeleton.bone(f"{side}_ankle"), 1],
            toes[:, 2].max(),
        ]

        joints, tip = _arm(mesh.vertices, ways, skeleton, side, sign)
        for name, point in zip(("shoulder", "elbow", "wrist"), joints, strict=True):
            move(f"{side}_{name}", point)
        tails[skeleton.bone(f"{side}_wrist")] = tip
    return replace(skeleton, heads=heads, tails=tails)


def _arm(
    vertices: Array, ways: csr_matrix, skeleton: Skeleton, side: str, sign: float
) -> tuple[tuple[Array, Array, Array], Array]:
    """Shoulder, elbow and wrist (3,) in the middle of an arm that points anywhere, and its finger tip (3,).

    Distances along the skin from the finger tip follow the arm however it is held and bent: bands of equal
    distance go round the arm alone, where planes across it would cut the trunk as well.
    """
    height = skeleton.tails[:, 1].max()
    bones = [skeleton.lengths[skeleton.bone(f"{side}_{name}")] for name in ("shoulder", "elbow", "wrist")]
    upper_share = bones[0] / sum(bones)
    shoulder = skeleton.heads[skeleton.bone(f"{side}_shoulder")]
    outermost = int(np.argmax(vertices[:, 0] * sign))
    distance = dijkstra(ways, directed=False, indices=outermost, limit=0.7 * height)
    tip = _finger_tip(vertices, distance, height)
    distance = dijkstra(ways, directed=False, indices=tip, limit=0.7 * height)
    reach = distance[np.argmin(np.linalg.norm(vertices - shoulder, axis=1))]
    if not np.isfinite(reach):
        raise MeshError("an arm is not joined to the trunk: the mesh is in pieces, far apart")

    def band(share: float) -> Array:
        return _middle(vertices[np.abs(distance - share * reach) < 0.012 * height])

    elbow, higher = band(1 - upper_share), band(1 - 0.45 * upper_share)
    along = (higher - elbow) / np.linalg.norm(higher - elbow)
    forearm = vertices[tip] - elbow
    wrist = _section(
        vertices[distance < (1 - upper_share) * reach],
        elbow + bones[1] / (bones[1] + bones[2]) * forearm,
        forearm / np.linalg.norm(forearm),
        0.012 * height,
    )
    upper = elbow + along * upper_share * reach
    # an arm is about 0.4 of the height long
    if np.linalg.norm(upper - shoulder) > 0.1 * height or reach < 0.3 * height:
        raise MeshError(_NO_LIMB)
    return (upper, elbow, wrist), vertices[tip]


def _finger_tip(vertices: Array, distance: Array, height: float) -> int:
    """The vertex farthest out along the hand; the outermost one, where ``distance`` starts, may be a knuckle.

    Skin beyond the end of its bone would see other bones under larger angles, and be rigged to them.
    """
    hand, forearm = distance < 0.1 * height, np.abs(distance - 0.2 * height) < 0.05 * height
    if not forearm.any():
        raise MeshError(_NO_LIMB)
    axis = vertices[hand].mean(0) - vertices[forearm].mean(0)
    return int(np.flatnonzero(hand)[np.argmax(vertices[hand] @ axis)])


def _ways_along_skin(mesh: Mesh, gap: float) -> csr_matrix:
    """Lengths (V, V) of the mesh's edges, and of the gaps between its pieces."""
    vertices = mesh.vertices
    edges = mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    # a few nearest vertices too: seams have their vertices twice, hands end in sleeves
    near, neighbours = cKDTree(vertices).query(vertices, k=min(6, len(vertices)), distance_upper_bound=gap)
    first, column = np.nonzero(np.isfinite(near[:, 1:]))
    gaps = np.column_stack([first, neighbours[first, column + 1]])
    edges = np.unique(np.sort(np.vstack([edges, gaps]), axis=1), axis=0).astype(np.int32)
    # zero would mean no edge
    length = np.maximum(np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1), 1e-9)
    return csr_matrix((length, (edges[:, 0], edges[:, 1])), shape=(len(vertices),) * 2)


def _section(points: Array, at: Array, normal: Array, thickness: float) -> Array:
    """Middle of the cross-section of a limb: the box centre of the points within ``thickness`` of a plane."""
    return _middle(points[np.abs((points - at) @ normal) < thickness])


def _middle(points: Array) -> Array:
    """Centre of the box around the points of a cross-section."""
    if len(points) < 4:
        raise MeshError(_NO_LIMB)
    return np.asarray((points.min(0) + points.max(0)) / 2)


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
