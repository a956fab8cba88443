"""Skinning weights by heat diffusion [Baran 2007]: bones are heat sources of the skin near them."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import sparse

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh import Mesh, mean_normals
from humansim_ros.geometry import angle_between
from humansim_ros.motion.body import Skeleton, limit_bones, side_of
from humansim_ros.people.rigging.landmarks import Volume, solid
from humansim_ros.types import Array

#: Heat transfer from bone to skin relative to diffusion; larger values give sharper joints.
CONDUCTION = 3.0
#: Largest distance in the heat transfer, since trunks are wide. (All lengths here are shares of the body
#: height.)
_FAR = 0.04
#: Offset of thighs beyond the planes at the hips, and width of the transition.
_GROIN, _SOFT = 0.025, 0.03
#: Distance of the start of the upper arm from the end of the collar bone.
_SHOULDER = 0.04
#: Distance of the end of the lowest trunk bone below the next joint, and width of the transition.
_PELVIS, _SHARP = 0.01, 0.01
#: Distance below which vertices are welded, so that heat crosses seams.
_WELD = 1e-5
#: A mesh with more points than this uses a coarser surface with this spacing for diffusion.
_MAX_POINTS, _COARSE = 100_000, 0.005
#: A mesh with more points than ``_FINE`` and more than ``_MANY`` faces longer than ``_LONG`` is solved
#: iteratively, with at most ``_STEPS`` steps.
_FINE, _MANY, _LONG, _STEPS = 5000, 100, 0.15, 400
#: Bones of the other side of the body fade out over this width.
_MIDDLE = 0.03
#: Smaller weights are removed.
_LEAST = 0.005
#: A bone outside the skin counts less by the factor ``_OUTSIDE``. It is outside if the cosine of its
#: direction to the normal is above ``_OVER``.
_OVER, _OUTSIDE = 0.3, 0.7
#: A bone does not heat skin that is farther from it than this factor times the distance to the nearest bone,
#: plus this distance.
_BEHIND, _NEAR = 1.5, 0.05
#: A bone does not heat skin through more air than this, as between an arm and the belly. Then: number of
#: samples on the way, and number of bones that are tried.
_AIR, _SAMPLES, _TRIES = 0.025, 20, 4
#: Height of the body in voxels.
_VOXELS = 160
#: A piece with a smaller share of the vertices (an eye, a button) moves with the surface that it touches.
_SMALL = 0.1
#: A piece is around a bone of a limb if its box contains this share of the bone.
_AROUND = 0.6
_TRUNK = ("HumanoidRoot", "sacroiliac", "vl5")


def heat_weights(mesh: Mesh, skeleton: Skeleton) -> sparse.csr_matrix:
    """Compute weights (V, B) of a mesh in the rest pose. A vertex has at most four bones. Rows sum to one.

    Solves ``(L + M H) w_b = M H p_b`` for each bone b: L is the cotangent Laplacian, M the vertex areas, H
    the heat transfer (inverse square of the distance). p_b is 1 where bone b is the heat source, else 0. In
    [Baran 2007] the nearest bone is the source. Here the source is the bone with the largest viewing angle
    [thesis §5] among bones under the skin and on the right side of planes through hips, shoulders and trunk
    joints. The mesh may be open, non-manifold, or in many pieces.
    """
    height = float(np.ptp(mesh.vertices[:, 1]))
    if not height > 0:
        raise MeshError("the mesh has no height")
    points, triangles, number = _welded(mesh, _WELD * height)
    coarse = len(points) > _MAX_POINTS
    if coarse:
        points, triangles, number = _welded(mesh, _COARSE * height)
    volume = solid(mesh, height / _VOXELS)
    source, distance = _sources(points, _normals(points, triangles), skeleton, volume, height)
    share = np.eye(len(skeleton))[source]
    stiffness, area = _laplacian(points, triangles)
    transfer = CONDUCTION * area / np.clip(distance, 1e-3 * height, _FAR * height) ** 2
    matrix = sparse.csc_matrix(stiffness + sparse.diags(transfer))
    if _has_long_faces(points, triangles, height):
        weights = _conjugate_gradients(matrix, transfer[:, None] * share)
    else:
        weights = np.asarray(sparse.linalg.splu(matrix).solve(transfer[:, None] * share))
    weights = _small_pieces(np.clip(weights, 0.0, None), points, triangles, skeleton)
    weights *= _own_side(points, skeleton, height)
    weights[weights < _LEAST * weights.sum(axis=1, keepdims=True)] = 0.0
    empty = weights.sum(axis=1) <= 0
    weights[empty] = share[empty]
    weights /= weights.sum(axis=1, keepdims=True)
    point_weights = sparse.csr_matrix(weights)
    if coarse:
        return limit_bones(_interpolation(mesh, points, triangles, number, _COARSE * height) @ point_weights)
    return limit_bones(point_weights)[number]


def _welded(mesh: Mesh, size: float) -> tuple[Array, NDArray[np.intp], NDArray[np.intp]]:
    """Weld vertices on a grid of ``size``. Returns points (P, 3), triangles (N, 3), and the point of each
    vertex (V,). Vertices left and right of the middle are not welded."""
    cells = np.round(mesh.vertices / size).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    if float(extent[0]) * float(extent[1]) * float(extent[2]) * 2 > 9e18:
        raise MeshError("the mesh is far wider or deeper than a person of its height")
    cell = ((cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]) * 2 + (mesh.vertices[:, 0] < 0)
    _, first, number = np.unique(cell, return_index=True, return_inverse=True)
    number = number.reshape(-1)
    points = mesh.vertices[first]
    triangles = number[mesh.triangles]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    return points, triangles, number


def _normals(points: Array, triangles: NDArray[np.intp]) -> Array:
    """Outward unit normals (P, 3). Each piece of the surface is oriented so that its volume is positive."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    area = np.asarray(np.cross(b - a, c - a), dtype=float)
    _, piece = _pieces(len(points), triangles)
    piece_of = piece[triangles[:, 0]]
    middle = np.zeros((piece_of.max(initial=0) + 1, 3))
    count = np.zeros(len(middle))
    np.add.at(middle, piece_of, (a + b + c) / 3)
    np.add.at(count, piece_of, 1.0)
    volume = np.zeros(len(middle))
    from_middle = a - (middle / np.maximum(count, 1)[:, None])[piece_of]
    np.add.at(volume, piece_of, np.einsum("ij,ij->i", from_middle, area))
    area *= np.where(volume < 0, -1.0, 1.0)[piece_of][:, None]
    return mean_normals(area, triangles, len(points))


def _sources(
    points: Array, normals: Array, skeleton: Skeleton, volume: Volume, height: float
) -> tuple[NDArray[np.intp], Array]:
    """Heat source of each point: bone (P,) and its distance (P,). ``points``, ``normals``: (P, 3) points on
    the skin in body space, and unit normals there. ``volume``: inside of the body of a ``height``, metres."""
    score = np.full((len(points), len(skeleton)), -1.0)
    far = np.zeros_like(score)
    side = np.sign(points[:, 0])
    along = (skeleton.tails - skeleton.heads) / skeleton.lengths[:, None]

    def beyond(bone: int, normal: Array) -> Array:
        """Distance (P,) of points beyond a plane through the head of a bone, as a share of the height."""
        return np.asarray((points - skeleton.heads[bone]) @ normal / height)

    for bone, name in enumerate(skeleton.names):
        along_bone = np.clip((points - skeleton.heads[bone]) @ along[bone], 0.0, skeleton.lengths[bone])
        to_bone = skeleton.heads[bone] + along_bone[:, None] * along[bone] - points
        far[:, bone] = np.linalg.norm(to_bone, axis=1)
        if "_to_" in name:  # connecting bones have no skin
            continue
        ends = (end - points for end in (skeleton.heads[bone], skeleton.tails[bone]))
        over = np.einsum("ij,ij->i", to_bone, normals) > _OVER * far[:, bone]
        angle = angle_between(*ends) * np.where(over, _OUTSIDE, 1.0)
        score[:, bone] = np.where(side * side_of(name) < 0, -1.0, angle)
    for letter in "lr":
        hip, shoulder = (skeleton.bone(f"{letter}_{joint}") for joint in ("hip", "shoulder"))
        # the groin runs half way between the thigh and its parent bone
        normal = along[hip] + along[skeleton.parents[hip]]
        normal /= max(float(np.linalg.norm(normal)), 1e-9)
        score[:, hip] *= np.clip(1 + (beyond(hip, normal) - _GROIN) / _SOFT, 0.0, 1.0)
        collar = skeleton.bone(f"{letter}_sternoclavicular")
        score[:, collar] *= np.clip(1 - (beyond(shoulder, along[shoulder]) + _SHOULDER) / _SHARP, 0.0, 1.0)
    trunk = [skeleton.bone(name) for name in _TRUNK]
    for lower, upper, less in zip(trunk[:-1], trunk[1:], (_PELVIS, 0.0), strict=True):
        up = beyond(upper, np.array([0.0, 1.0, 0.0])) + less
        score[:, lower] *= np.clip(1 - up / _SHARP, 0.0, 1.0)
        score[:, upper] *= np.clip(1 + up / _SHARP, 0.0, 1.0)
    # a bone far behind another one is no heat source, whatever its viewing angle
    score[far > _BEHIND * far.min(axis=1, keepdims=True) + _NEAR * height] -= 2 * np.pi
    source = _first_visible(points, score, skeleton, volume, _AIR * height)
    return source, far[np.arange(len(points)), source]


def _first_visible(
    points: Array, score: Array, skeleton: Skeleton, volume: Volume, most_air: float
) -> NDArray[np.intp]:
    """Bone (P,) with the highest ``score`` (P, B), among the bones with a straight line to the point (P, 3)
    inside the body. ``most_air``: metres outside the body up to which a line counts as inside."""
    source = score.argmax(axis=1)
    limbs = np.array([side_of(name) != 0 and "_to_" not in name for name in skeleton.names])
    rows = np.flatnonzero(limbs[source])
    scores = score[rows]
    for _ in range(_TRIES):
        if not len(rows):
            break
        bone = scores.argmax(axis=1)
        hidden = _air_between(points[rows], bone, skeleton, volume) > most_air
        source[rows[~hidden]] = bone[~hidden]
        scores = scores[hidden]
        scores[np.arange(len(scores)), bone[hidden]] = -10.0
        rows = rows[hidden]
    return source


def _air_between(points: Array, bones: NDArray[np.intp], skeleton: Skeleton, volume: Volume) -> Array:
    """For the straight line from each point to the nearest point of its bone: the length (P,) that is outside
    the body."""
    head, step = skeleton.heads[bones], (skeleton.tails - skeleton.heads)[bones]
    place = np.einsum("ij,ij->i", points - head, step) / skeleton.lengths[bones] ** 2
    way = head + np.clip(place, 0.0, 1.0)[:, None] * step - points
    air = np.zeros(len(points))
    for share in (np.arange(_SAMPLES) + 0.5) / _SAMPLES:
        air += ~volume.filled[tuple(volume.voxel_of(points + share * way).T)]
    return np.asarray(air / _SAMPLES * np.linalg.norm(way, axis=1))


def _laplacian(points: Array, triangles: NDArray[np.intp]) -> tuple[sparse.csr_matrix, Array]:
    """Cotangent Laplacian (P, P), positive semidefinite, and the area of each point (P,).

    Cotangents have a positive minimum, so that heat does not flow backwards on sliver triangles.
    """
    n = len(points)
    rows, columns, values = [], [], []
    areas = np.zeros(n)
    for k in range(3):
        i, j, o = (triangles[:, (k + m) % 3] for m in range(3))
        u, v = points[i] - points[o], points[j] - points[o]
        twice = np.linalg.norm(np.cross(u, v), axis=1)
        cotangent = np.clip(np.einsum("ij,ij->i", u, v) / np.maximum(twice, 1e-12), 0.05, 20.0)
        rows += [i, j]
        columns += [j, i]
        values += [cotangent / 2, cotangent / 2]
        np.add.at(areas, o, twice / 6)
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    flow = sparse.csr_matrix(entries, shape=(n, n))
    laplacian = sparse.diags(np.asarray(flow.sum(axis=1)).ravel()) - flow
    return laplacian.tocsr(), np.maximum(areas, 1e-9)


def _has_long_faces(points: Array, triangles: NDArray[np.intp], height: float) -> bool:
    """Whether long faces connect distant parts of a fine mesh, so that its matrix would have no sparse
    factors."""
    corners = points[triangles]
    longest = np.abs(corners - np.roll(corners, 1, axis=1)).max(axis=(1, 2))
    return len(points) > _FINE and int((longest > _LONG * height).sum()) > _MANY


def _conjugate_gradients(matrix: sparse.csc_matrix, right: Array) -> Array:
    """Solve for all columns (P, B) together by conjugate gradients."""
    scale = 1 / matrix.diagonal()[:, None]
    solution = np.zeros_like(right)
    residual = right.copy()
    step = scale * residual
    size = np.einsum("ij,ij->j", residual, step)
    least = 1e-10 * np.maximum(size, 1e-300)
    for _ in range(_STEPS):
        product = matrix @ step
        length = size / np.maximum(np.einsum("ij,ij->j", step, product), 1e-300)
        solution += length * step
        residual -= length * product
        direction = scale * residual
        following = np.einsum("ij,ij->j", residual, direction)
        if (following <= least).all():
            break
        step = direction + following / np.maximum(size, 1e-300) * step
        size = following
    return solution


def _interpolation(
    mesh: Mesh, points: Array, triangles: NDArray[np.intp], number: NDArray[np.intp], size: float
) -> sparse.csr_matrix:
    """Matrix (V, P) that interpolates values at vertices from the point of each vertex and its neighbouring
    points. Rows sum to 1. ``points``, ``triangles``: coarser surface. ``number``: (V,) point of each vertex.
    ``size``: distance between neighbouring points, metres."""
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    every = np.arange(len(points))
    rows = np.concatenate([every, edges[:, 0], edges[:, 1]])
    columns = np.concatenate([every, edges[:, 1], edges[:, 0]])
    ones = np.ones(len(rows), np.float32)
    near = sparse.csr_matrix((ones, (rows, columns)), shape=(len(points),) * 2)[number]
    vertex = np.repeat(np.arange(len(number)), np.diff(near.indptr))
    distance = np.linalg.norm(mesh.vertices[vertex] - points[near.indices], axis=1)
    near.data = np.maximum(1 - distance / (2 * size), 1e-3) ** 2
    return sparse.csr_matrix(sparse.diags(1 / np.asarray(near.sum(axis=1)).ravel()) @ near)


def _pieces(count: int, triangles: NDArray[np.intp]) -> tuple[int, NDArray[np.intp]]:
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    graph = sparse.coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    number, piece = sparse.csgraph.connected_components(graph, directed=False)
    return number, piece.astype(np.intp)


def _small_pieces(weights: Array, points: Array, triangles: NDArray[np.intp], skeleton: Skeleton) -> Array:
    """Give each small piece of the surface the mean weights (B,) of the nearest points of the body. A piece
    around a bone of a limb, such as an arm or a sleeve, does not count as small."""
    number, piece = _pieces(len(points), triangles)
    size = np.bincount(piece, minlength=number)
    small = size < _SMALL * size.max()
    order = np.argsort(piece, kind="stable")
    starts = np.searchsorted(piece[order], np.arange(number))
    low, high = (bound.reduceat(points[order], starts) for bound in (np.minimum, np.maximum))
    for bone, name in enumerate(skeleton.names):
        if side_of(name) != 0 and "_to_" not in name:
            ends = skeleton.heads[bone], skeleton.tails[bone]
            along = np.linspace(*ends, _SAMPLES)[:, None]
            inside = ((along > low) & (along < high)).all(axis=2).mean(axis=0)
            small &= inside < _AROUND
    if not small.any() or small.all():
        return weights
    body, rows = np.flatnonzero(~small[piece]), np.flatnonzero(small[piece])
    _, near = scipy.spatial.cKDTree(points[body]).query(points[rows])
    total = np.zeros((number, weights.shape[1]))
    np.add.at(total, piece[rows], weights[body[near]])
    out = weights.copy()
    out[rows] = total[piece[rows]] / size[piece[rows], None]
    return out


def _own_side(points: Array, skeleton: Skeleton, height: float) -> Array:
    """Factors (P, B) that remove bones of the other side of the body."""
    sides = np.array([side_of(name) for name in skeleton.names])
    across = -points[:, :1] * sides[None, :]  # positive on the other side
    return np.where(sides == 0, 1.0, np.clip(1.0 - across / (_MIDDLE * height), 0.0, 1.0))
