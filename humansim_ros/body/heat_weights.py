"""Automatic rigging by heat: every bone warms the skin that is nearest to it, and the warmth spreads along
the surface (Baran and Popovic, Automatic Rigging and Animation of 3D Characters, 2007, section 4).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from humansim_ros.body.skeleton import Skeleton, side_of
from humansim_ros.body.volume import Volume, solid
from humansim_ros.body.weights import limit_bones
from humansim_ros.errors import MeshError
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.mesh.normals import mean_normals
from humansim_ros.rotations import angle_between
from humansim_ros.types import Array

#: How fast skin takes the warmth of its bone, by how fast warmth spreads: the larger, the harder the joints.
CONDUCTION = 3.0
#: All that follows in shares of the body's height. A bone farther from the skin than this warms it as well as
#: from here: trunks and bellies are wide.
_FAR = 0.04
#: Thighs begin this far beyond the planes that cut them off at the hips, and over so much around there.
_GROIN, _SOFT = 0.025, 0.03
#: The upper arm begins this far before the end of the collar bone.
_SHOULDER = 0.04
#: The lowest trunk bone ends this far below the next one's joint, the others at it; so much around there.
_PELVIS, _SHARP = 0.01, 0.01
#: Vertices closer than this are one, so that seams do not stop the warmth.
_WELD = 1e-5
#: Of more points than this the warmth flows over a coarser surface, of points so far apart.
_MAX_POINTS, _COARSE = 100_000, 0.005
#: A mesh of more points is tangled by this many faces longer than this; how many steps it gets.
_FINE, _MANY, _LONG, _STEPS = 5000, 100, 0.15, 400
#: The other side's bones fade out over this much.
_MIDDLE = 0.03
#: Weights below this are none.
_LEAST = 0.005
#: A bone over the skin (by the cosine of its direction to the normal) instead of under it counts less.
_OVER, _OUTSIDE = 0.3, 0.7
#: A bone warms no skin that is so many times farther from it than from another, and this farther.
_BEHIND, _NEAR = 1.5, 0.05
#: Nor does it through more air than this (arms beside the belly): looks on the way, bones tried.
_AIR, _LOOKS, _TRIES = 0.025, 20, 4
#: Cubes that the body is tall, to tell its inside.
_CUBES = 160
#: A piece of fewer vertices than this share of the mesh (an eye, a button) moves as what it sits on.
_SMALL = 0.1
_TRUNK = ("HumanoidRoot", "sacroiliac", "vl5")


def heat_weights(mesh: Mesh, skeleton: Skeleton) -> sparse.csr_matrix:
    """Weights (V, B) of a mesh in the skeleton's rest pose; at most four a vertex, rows sum to one.

    Solves ``(L + M H) w_b = M H p_b`` for each bone: L the cotangent Laplacian, M the vertices' areas, H what
    a vertex takes from its bone (by the square of the distance), p_b whether that is bone b. Which bone warms
    a vertex is not the nearest, as there, but the one seen under the largest angle (thesis chapter 5), on the
    right side of the planes through hips, shoulders and the trunk's joints, and under the skin. Open,
    non-manifold and many-piece meshes will do.
    """
    height = float(np.ptp(mesh.vertices[:, 1]))
    if not height > 0:
        raise MeshError("the mesh has no height: there is nothing to rig")
    points, triangles, number = _welded(mesh, _WELD * height)
    coarse = len(points) > _MAX_POINTS
    if coarse:
        points, triangles, number = _welded(mesh, _COARSE * height)
    volume = solid(mesh, height / _CUBES)
    source, distance = _sources(points, _normals(points, triangles), skeleton, volume, height)
    share = np.eye(len(skeleton))[source]
    stiffness, area = _laplacian(points, triangles)
    taken = CONDUCTION * area / np.clip(distance, 1e-3 * height, _FAR * height) ** 2
    matrix = sparse.csc_matrix(stiffness + sparse.diags(taken))
    if _tangled(points, triangles, height):
        weights = _by_descent(matrix, taken[:, None] * share)
    else:
        weights = np.asarray(splu(matrix).solve(taken[:, None] * share))
    weights = _small_pieces(np.clip(weights, 0.0, None), points, triangles)
    weights *= _own_side(points, skeleton, height)
    weights[weights < _LEAST * weights.sum(axis=1, keepdims=True)] = 0.0
    lost = weights.sum(axis=1) <= 0
    weights[lost] = share[lost]
    weights /= weights.sum(axis=1, keepdims=True)
    found = sparse.csr_matrix(weights)
    if coarse:
        return limit_bones(_between(mesh, points, triangles, number, _COARSE * height) @ found)
    return limit_bones(found)[number]


def _welded(mesh: Mesh, size: float) -> tuple[Array, NDArray[np.intp], NDArray[np.intp]]:
    """Points (P, 3) that are ``size`` apart, triangles (N, 3) of them, and the point of each vertex (V,).

    Vertices left and right of the middle stay apart.
    """
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
    """Outward unit normals (P, 3); each piece of the surface is turned so that its volume is positive."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    area = np.asarray(np.cross(b - a, c - a), dtype=float)
    _, piece = _pieces(len(points), triangles)
    own = piece[triangles[:, 0]]
    middle = np.zeros((own.max(initial=0) + 1, 3))
    count = np.zeros(len(middle))
    np.add.at(middle, own, (a + b + c) / 3)
    np.add.at(count, own, 1.0)
    volume = np.zeros(len(middle))
    np.add.at(volume, own, np.einsum("ij,ij->i", a - (middle / np.maximum(count, 1)[:, None])[own], area))
    area *= np.where(volume < 0, -1.0, 1.0)[own][:, None]
    return mean_normals(area, triangles, len(points))


def _sources(
    points: Array, normals: Array, skeleton: Skeleton, volume: Volume, height: float
) -> tuple[NDArray[np.intp], Array]:
    """The bone that warms each point (P,), and how far it is (P,)."""
    seen = np.full((len(points), len(skeleton)), -1.0)
    far = np.zeros_like(seen)
    side = np.sign(points[:, 0])
    along = (skeleton.tails - skeleton.heads) / skeleton.lengths[:, None]

    def beyond(bone: int, normal: Array) -> Array:
        """How far (P,) points are beyond the plane through a bone's head, in heights."""
        return np.asarray((points - skeleton.heads[bone]) @ normal / height)

    for bone, name in enumerate(skeleton.names):
        place = np.clip((points - skeleton.heads[bone]) @ along[bone], 0.0, skeleton.lengths[bone])
        way = skeleton.heads[bone] + place[:, None] * along[bone] - points
        far[:, bone] = np.linalg.norm(way, axis=1)
        if "_to_" in name:  # it connects, and carries no skin
            continue
        ends = (end - points for end in (skeleton.heads[bone], skeleton.tails[bone]))
        over = np.einsum("ij,ij->i", way, normals) > _OVER * far[:, bone]
        angle = angle_between(*ends) * np.where(over, _OUTSIDE, 1.0)
        seen[:, bone] = np.where(side * side_of(name) < 0, -1.0, angle)
    for letter in "lr":
        hip, shoulder = (skeleton.bone(f"{letter}_{joint}") for joint in ("hip", "shoulder"))
        # the groin runs half way between the thigh and what joins it to the pelvis
        normal = along[hip] + along[skeleton.parents[hip]]
        normal /= max(float(np.linalg.norm(normal)), 1e-9)
        seen[:, hip] *= np.clip(1 + (beyond(hip, normal) - _GROIN) / _SOFT, 0.0, 1.0)
        collar = skeleton.bone(f"{letter}_sternoclavicular")
        seen[:, collar] *= np.clip(1 - (beyond(shoulder, along[shoulder]) + _SHOULDER) / _SHARP, 0.0, 1.0)
    trunk = [skeleton.bone(name) for name in _TRUNK]
    for lower, upper, less in zip(trunk[:-1], trunk[1:], (_PELVIS, 0.0), strict=True):
        up = beyond(upper, np.array([0.0, 1.0, 0.0])) + less
        seen[:, lower] *= np.clip(1 - up / _SHARP, 0.0, 1.0)
        seen[:, upper] *= np.clip(1 + up / _SHARP, 0.0, 1.0)
    # a bone far behind another one does not warm, however well it is seen
    seen[far > _BEHIND * far.min(axis=1, keepdims=True) + _NEAR * height] -= 2 * np.pi
    source = _first_visible(points, seen, skeleton, volume, _AIR * height)
    return source, far[np.arange(len(points)), source]


def _first_visible(
    points: Array, seen: Array, skeleton: Skeleton, volume: Volume, most_air: float
) -> NDArray[np.intp]:
    """The bone (P,) of the highest score (P, B) whose way to the point leads through the body, not air."""
    source = seen.argmax(axis=1)
    limbs = np.array([side_of(name) != 0 and "_to_" not in name for name in skeleton.names])
    rows = np.flatnonzero(limbs[source])
    scores = seen[rows]
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
    """How much (P,) of the straight way from each point to the nearest place on its bone is outside."""
    head, step = skeleton.heads[bones], (skeleton.tails - skeleton.heads)[bones]
    place = np.einsum("ij,ij->i", points - head, step) / skeleton.lengths[bones] ** 2
    way = head + np.clip(place, 0.0, 1.0)[:, None] * step - points
    air = np.zeros(len(points))
    for share in (np.arange(_LOOKS) + 0.5) / _LOOKS:
        air += ~volume.filled[tuple(volume.cube_of(points + share * way).T)]
    return np.asarray(air / _LOOKS * np.linalg.norm(way, axis=1))


def _laplacian(points: Array, triangles: NDArray[np.intp]) -> tuple[sparse.csr_matrix, Array]:
    """Cotangent Laplacian (P, P), positive semidefinite, and the area of each point (P,).

    Cotangents below a little above zero are raised to that: on slivers the warmth may not flow backwards.
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


def _tangled(points: Array, triangles: NDArray[np.intp], height: float) -> bool:
    """Whether many long faces join far parts of a fine mesh: its matrix would have no sparse factors."""
    corners = points[triangles]
    longest = np.abs(corners - np.roll(corners, 1, axis=1)).max(axis=(1, 2))
    return len(points) > _FINE and int((longest > _LONG * height).sum()) > _MANY


def _by_descent(matrix: sparse.csc_matrix, right: Array) -> Array:
    """Solutions (P, B) by conjugate gradients, for all columns together."""
    scale = 1 / matrix.diagonal()[:, None]
    solution = np.zeros_like(right)
    rest = right.copy()
    step = scale * rest
    size = np.einsum("ij,ij->j", rest, step)
    least = 1e-10 * np.maximum(size, 1e-300)
    for _ in range(_STEPS):
        pushed = matrix @ step
        length = size / np.maximum(np.einsum("ij,ij->j", step, pushed), 1e-300)
        solution += length * step
        rest -= length * pushed
        towards = scale * rest
        following = np.einsum("ij,ij->j", rest, towards)
        if (following <= least).all():
            break
        step = towards + following / np.maximum(size, 1e-300) * step
        size = following
    return solution


def _between(
    mesh: Mesh, points: Array, triangles: NDArray[np.intp], number: NDArray[np.intp], size: float
) -> sparse.csr_matrix:
    """Shares (V, P), rows sum to one, of a vertex in its point ``number`` (V,) and that one's neighbours."""
    edges = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    own = np.arange(len(points))
    rows = np.concatenate([own, edges[:, 0], edges[:, 1]])
    columns = np.concatenate([own, edges[:, 1], edges[:, 0]])
    near = sparse.csr_matrix((np.ones(len(rows), np.float32), (rows, columns)), shape=(len(points),) * 2)[
        number
    ]
    vertex = np.repeat(np.arange(len(number)), np.diff(near.indptr))
    away = np.linalg.norm(mesh.vertices[vertex] - points[near.indices], axis=1)
    near.data = np.maximum(1 - away / (2 * size), 1e-3) ** 2
    return sparse.csr_matrix(sparse.diags(1 / np.asarray(near.sum(axis=1)).ravel()) @ near)


def _pieces(count: int, triangles: NDArray[np.intp]) -> tuple[int, NDArray[np.intp]]:
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    graph = sparse.coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    number, piece = connected_components(graph, directed=False)
    return number, piece.astype(np.intp)


def _small_pieces(weights: Array, points: Array, triangles: NDArray[np.intp]) -> Array:
    """Weights (P, B) in which a small piece of the surface has, all of it, those of where it sits."""
    number, piece = _pieces(len(points), triangles)
    size = np.bincount(piece, minlength=number)
    small = size < _SMALL * size.max()
    if not small.any() or small.all():
        return weights
    body, rows = np.flatnonzero(~small[piece]), np.flatnonzero(small[piece])
    _, near = cKDTree(points[body]).query(points[rows])
    total = np.zeros((number, weights.shape[1]))
    np.add.at(total, piece[rows], weights[body[near]])
    out = weights.copy()
    out[rows] = total[piece[rows]] / size[piece[rows], None]
    return out


def _own_side(points: Array, skeleton: Skeleton, height: float) -> Array:
    """(P, B) how much of its warmth a bone may keep there: nothing well across the middle of the body."""
    sides = np.array([side_of(name) for name in skeleton.names])
    across = -points[:, :1] * sides[None, :]  # positive on the other side
    return np.where(sides == 0, 1.0, np.clip(1.0 - across / (_MIDDLE * height), 0.0, 1.0))
