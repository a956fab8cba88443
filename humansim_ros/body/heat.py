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

from humansim_ros.body.mesh import Mesh
from humansim_ros.body.skeleton import Skeleton, side_of
from humansim_ros.body.weights import limit_bones
from humansim_ros.rotations import Array, angle_between

#: How fast skin takes the warmth of its bone, by how fast warmth spreads: the larger, the harder the joints.
CONDUCTION = 3.0
#: All that follows in shares of the body's height. A bone farther from the skin than this warms it as well as
#: from here: trunks and bellies are wide.
_FAR = 0.04
#: Thighs begin this far beyond the planes that cut them off at the hips, and over so much around there.
_GROIN, _SOFT = 0.03, 0.03
#: The upper arm begins this far before the end of the collar bone.
_SHOULDER = 0.03
#: The lowest trunk bone ends this far below the next one's joint, the others at it; so much around there.
_PELVIS, _SHARP = 0.02, 0.01
#: Vertices closer than this are one, so that seams do not stop the warmth.
_WELD = 1e-5
#: The other side's bones fade out over this much.
_MIDDLE = 0.03
#: Weights below this are none.
_LEAST = 0.005
#: A bone over the skin (by the cosine of its direction to the normal) instead of under it counts less.
_OVER, _OUTSIDE = 0.3, 0.4
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
    points, triangles, number = _welded(mesh, height)
    source, distance = _sources(points, _normals(points, triangles), skeleton, height)
    share = np.eye(len(skeleton))[source]
    stiffness, area = _laplacian(points, triangles)
    taken = CONDUCTION * area / np.clip(distance, 1e-3 * height, _FAR * height) ** 2
    solver = splu((stiffness + sparse.diags(taken)).tocsc())
    weights = np.asarray(solver.solve(taken[:, None] * share))
    weights = _small_pieces(np.clip(weights, 0.0, None), points, triangles)
    weights *= _own_side(points, skeleton, height)
    weights[weights < _LEAST * weights.sum(axis=1, keepdims=True)] = 0.0
    lost = weights.sum(axis=1) <= 0
    weights[lost] = share[lost]
    weights /= weights.sum(axis=1, keepdims=True)
    return limit_bones(sparse.csr_matrix(weights[number]))


def _welded(mesh: Mesh, height: float) -> tuple[Array, NDArray[np.intp], NDArray[np.intp]]:
    """Distinct points (P, 3), triangles (N, 3) of them with an area, and the point of each vertex (V,)."""
    cells = np.round(mesh.vertices / (_WELD * height)).astype(np.int64)
    _, first, number = np.unique(cells, axis=0, return_index=True, return_inverse=True)
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
    normals = np.zeros_like(points)
    for k in range(3):
        np.add.at(normals, triangles[:, k], area)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def _sources(
    points: Array, normals: Array, skeleton: Skeleton, height: float
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
    source = seen.argmax(axis=1)
    return source, far[np.arange(len(points)), source]


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
    body = np.flatnonzero(~small[piece])
    tree = cKDTree(points[body])
    out = weights.copy()
    order = np.argsort(piece, kind="stable")
    starts = np.concatenate([[0], np.cumsum(size)])
    for one in np.flatnonzero(small):
        rows = order[starts[one] : starts[one + 1]]
        _, near = tree.query(points[rows])
        out[rows] = weights[body[near]].mean(axis=0)
    return out


def _own_side(points: Array, skeleton: Skeleton, height: float) -> Array:
    """(P, B) how much of its warmth a bone may keep there: nothing well across the middle of the body."""
    sides = np.array([side_of(name) for name in skeleton.names])
    across = -points[:, :1] * sides[None, :]  # positive on the other side
    return np.where(sides == 0, 1.0, np.clip(1.0 - across / (_MIDDLE * height), 0.0, 1.0))
