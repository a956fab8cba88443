"""Levels of detail of a mesh. Edges collapse into one of their vertices, so that the remaining vertices are a
subset.

Collapses with the smallest quadric error [Garland 1997] come first. The error counts in several poses at
once, so that a surface that bends keeps its vertices at the bend. A vertex of a texture seam only moves along
the seam. Borders stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from humansim_ros.types import Array, Indices

#: Share of the cheapest collapses that are tried in each round.
_TRIED = 0.35
#: Smallest cosine between the normals of a triangle before and after a collapse.
_LEAST_COSINE = 0.3
#: The error of a level holds for this share of the vertices: they deviate by at most this error.
_WITHIN = 0.95
#: Up to a limit of the error, rounds go on as long as each removes more than this share of the triangles.
_LEAST_REMOVED = 0.003
#: Number of vertices at which :func:`bounded_errors` measures, and the share of them that the error must hold
#: for. This share is two standard deviations above ``_WITHIN``.
_SAMPLES, _WITHIN_SAMPLES = 2000, 0.96
_UPPER = np.triu_indices(4)
_TWICE = np.where(_UPPER[0] == _UPPER[1], 1.0, 2.0)


@dataclass(frozen=True)
class Simplification:
    """Simpler versions of a mesh. Level 0 is the mesh itself.

    ``parents``: (V,) vertex that each vertex collapses into. A vertex that stays at all levels has its own
    number. ``coordinate_parents``: (T,) the same for texture coordinates. ``removed_at``: (V,) first level
    without the vertex, 255 if the vertex stays. ``errors``: (K + 1,) metres, one per level. 95 % of the
    vertices are nearer to the surface of the level than this, in all poses.
    """

    parents: Indices
    coordinate_parents: Indices
    removed_at: NDArray[np.uint8]
    errors: Array

    @cached_property
    def counts(self) -> Indices:
        """(K + 1,) number of vertices of each level, of the mesh itself first."""
        return np.array([int((self.removed_at > number).sum()) for number in range(len(self.errors))])

    def level(
        self, number: int, triangles: NDArray[np.integer], coordinates: NDArray[np.integer]
    ) -> _Triangles:
        """Triangles (N, 3) of a level, and their texture coordinates (N, 3), as indices into the arrays of
        the mesh."""
        vertices = self.vertices_of(number)
        stays = self.removed_at > number
        owner = np.zeros(len(self.coordinate_parents), np.intp)
        owner[coordinates] = triangles
        found = _followed(self.coordinate_parents, stays[owner])
        return _without_degenerate(vertices[triangles], found[coordinates])

    def vertices_of(self, number: int) -> Indices:
        """(V,) vertex of a level that stands for each vertex."""
        return _followed(self.parents, self.removed_at > number)


_Triangles = tuple[Indices, Indices]


def simplify(
    poses: Array, triangles: NDArray[np.integer], coordinates: NDArray[np.integer], shares: Sequence[float]
) -> Simplification:
    """Simplify a mesh.

    Args:
        poses: Vertices in P poses, (P, V, 3) metres. The first is the rest pose.
        triangles: (N, 3).
        coordinates: Indices of texture coordinates of the triangles, (N, 3). No two vertices share a
            coordinate.
        shares: Number of triangles of each level, as a share of N, decreasing. Levels that cannot be reached
            are left out.
    """
    work = _Collapsing(poses, triangles, coordinates)
    count = len(triangles)
    removed_at = np.full(poses.shape[1], 255, np.uint8)
    errors = [0.0]
    for number, share in enumerate(shares, 1):
        before = work.parents.copy()
        goal = int(share * count)
        while len(work.triangles) > goal and work.collapse(goal):
            pass
        if len(work.triangles) > goal:
            work.parents = before
            break
        gone = (work.parents != np.arange(len(before))) & (removed_at == 255)
        removed_at[gone] = number
        final = _followed(work.parents, removed_at == 255)
        errors.append(float(np.quantile(_deviations(poses, work.triangles, final), _WITHIN)))
    return Simplification(work.parents, work.coordinate_parents, removed_at, np.array(errors))


def simplify_within(
    poses: Array, triangles: NDArray[np.integer], coordinates: NDArray[np.integer], limits: Sequence[float]
) -> Simplification:
    """Simplify a mesh, or a patch of one, as far as its quadric error allows.

    Args:
        poses, triangles, coordinates: The same as in :func:`simplify`.
        limits: Largest quadric error of the collapses of each level, metres, increasing. They become
            ``errors`` of the result. :func:`bounded_errors` measures the true errors.
    """
    work = _Collapsing(poses, triangles, coordinates)
    removed_at = np.full(poses.shape[1], 255, np.uint8)
    for number, limit in enumerate(limits, 1):
        removed = len(work.triangles)
        while removed > _LEAST_REMOVED * len(work.triangles):
            before = len(work.triangles)
            if not work.collapse(0, limit**2):
                break
            removed = before - len(work.triangles)
        removed_at[(work.parents != np.arange(len(removed_at))) & (removed_at == 255)] = number
    return Simplification(work.parents, work.coordinate_parents, removed_at, np.array([0.0, *limits]))


def patches(triangles: NDArray[np.integer], coordinates: NDArray[np.integer]) -> Indices:
    """Divide a mesh into patches that can be simplified independently. Returns the patch (N,) of each
    triangle. Patches meet at edges with two vertices that never move. Such vertices have more than two
    texture coordinates, as at the hems of clothes."""
    count, number = int(triangles.max()) + 1, int(coordinates.max()) + 1
    distinct = np.unique(triangles.ravel().astype(np.int64) * number + coordinates.ravel()) // number
    fixed = np.bincount(distinct, minlength=count) > 2
    start, end = triangles.ravel().astype(np.int64), triangles[:, [1, 2, 0]].ravel()
    key = np.where(fixed[start] & fixed[end], -1, np.minimum(start, end) * count + np.maximum(start, end))
    order = np.argsort(key, kind="stable")
    same = (np.diff(key[order]) == 0) & (key[order][1:] >= 0)
    one, two = order[:-1][same] // 3, order[1:][same] // 3
    graph = coo_matrix((np.ones(len(one)), (one, two)), shape=(len(triangles),) * 2)
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.intp)


def bounded_errors(
    levels: Simplification, poses: Array, triangles: NDArray[np.integer], coordinates: NDArray[np.integer]
) -> Simplification:
    """Measure the errors of levels at some of the vertices. The true errors are hardly ever larger.

    The triangle that is nearest in the rest pose is taken as the nearest one in each pose.

    Args:
        levels: Levels of a mesh.
        poses, triangles, coordinates: The same as in :func:`simplify`.
    """
    step = max(1, len(levels.parents) // _SAMPLES)
    chosen = np.random.default_rng(0).permutation(len(levels.parents))[::step]
    errors = [0.0]
    for number in range(1, len(levels.errors)):
        surface, vertices = levels.level(number, triangles, coordinates)[0], levels.vertices_of(number)
        removed = chosen[vertices[chosen] != chosen]
        around = _incidence(surface, len(vertices))
        neighbours = (around[vertices[removed]] @ (around.T @ around)).tocsr()
        which, near = _rows(neighbours, np.arange(len(removed)))
        distances = _distances(poses[0, removed[which]], poses[0, surface[near]])
        order = np.lexsort((distances, which))
        first = order[np.diff(which[order], prepend=-1) != 0]
        found = np.zeros(len(chosen))
        for pose in poses:
            far = _distances(pose[removed], pose[surface[near[first]]])
            found[: len(removed)] = np.maximum(found[: len(removed)], far)
        errors.append(float(np.quantile(found, _WITHIN_SAMPLES)))
    return replace(levels, errors=np.maximum.accumulate(errors))


class _Collapsing:
    """Collapses edges of a mesh. Each round collapses many edges that are apart from each other."""

    def __init__(
        self, poses: Array, triangles: NDArray[np.integer], coordinates: NDArray[np.integer]
    ) -> None:
        self.poses = poses
        self.triangles, self.coordinates = triangles.astype(np.intp), coordinates.astype(np.intp)
        self.parents: Indices = np.arange(poses.shape[1])
        self.coordinate_parents: Indices = np.arange(int(coordinates.max()) + 1)
        homogeneous = np.concatenate([poses, np.ones((*poses.shape[:2], 1))], axis=-1)
        #: (P, V, 10) products of the coordinates; quadrics, and areas (P, V), of the surface at each vertex
        self._products = homogeneous[..., _UPPER[0]] * homogeneous[..., _UPPER[1]] * _TWICE
        self._quadrics, self._areas = self._of_planes()
        self._refused = np.zeros(0, np.intp)

    def _of_planes(self) -> tuple[Array, Array]:
        corners = [self.poses[:, self.triangles[:, i]] for i in range(3)]
        normals = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        areas = np.linalg.norm(normals, axis=-1) / 2
        normals /= np.maximum(2 * areas, 1e-30)[..., None]
        planes = np.concatenate([normals, -np.einsum("pnk,pnk->pn", normals, corners[0])[..., None]], axis=-1)
        quadrics = planes[..., _UPPER[0]] * planes[..., _UPPER[1]] * areas[..., None] / 3
        around = _incidence(self.triangles, self.poses.shape[1])
        return np.stack([around @ each for each in quadrics]), (around @ (areas.T / 3)).T

    def collapse(self, goal: int, largest: float = np.inf) -> bool:
        """Do one round: collapse the cheapest edges, but stop at about ``goal`` triangles. An edge with
        a squared error above ``largest`` is not collapsed. Returns False if no edge is left to try."""
        count = self.poses.shape[1]
        gone, kept, sides, neighbours = self._edges()
        if not len(gone):
            return False
        cost = np.zeros(len(gone))
        for quadrics, areas, products in zip(self._quadrics, self._areas, self._products, strict=True):
            squares = ((quadrics[gone] + quadrics[kept]) * products[kept]).sum(axis=1)
            np.maximum(cost, squares / np.maximum(areas[gone] + areas[kept], 1e-12), out=cost)
        order = np.lexsort((cost, gone))
        best = order[np.diff(gone[order], prepend=-1) != 0]
        best = best[cost[best] <= min(np.quantile(cost[best], _TRIED), largest)]
        bad = self._is_bad(gone[best], kept[best], neighbours)
        self._refused = np.append(self._refused, gone[best[bad]] * count + kept[best[bad]])
        best = best[~bad]
        # edges that are the cheapest of all around the neighbours of their vertex
        rank = np.full(count, count)
        rank[gone[best]] = np.argsort(np.argsort(cost[best], kind="stable"), kind="stable")
        pairs = neighbours.tocoo()
        lowest = rank
        for _ in range(2):
            around = lowest.copy()
            np.minimum.at(around, pairs.row, lowest[pairs.col])
            lowest = around
        chosen = best[lowest[gone[best]] == rank[gone[best]]]
        chosen = chosen[np.argsort(cost[chosen], kind="stable")][: (len(self.triangles) - goal + 1) // 2]
        self._apply(gone[chosen], kept[chosen], sides[:, chosen])
        return True

    def _edges(self) -> tuple[Indices, Indices, Indices, csr_matrix]:
        """Edges that may collapse, as the vertices that go (E,) and the vertices that stay (E,). Returns also
        their texture coordinates (4, E): of both vertices on one side of the edge, then on the other side;
        and all pairs of neighbours (V, V)."""
        count = self.poses.shape[1]
        start, end = self.triangles.ravel(), self.triangles[:, [1, 2, 0]].ravel()
        first, second = self.coordinates.ravel(), self.coordinates[:, [1, 2, 0]].ravel()
        key = np.minimum(start, end) * count + np.maximum(start, end)
        order = np.argsort(key, kind="stable")
        begins = np.flatnonzero(np.diff(key[order], prepend=-1))
        sizes = np.diff(np.append(begins, len(order)))
        fixed = np.zeros(count, bool)
        other = order[begins[sizes != 2]]
        fixed[start[other]] = fixed[end[other]] = True
        one, two = order[begins[sizes == 2]], order[begins[sizes == 2] + 1]
        opposite = start[one] == end[two]
        near, far = np.where(opposite, second[two], first[two]), np.where(opposite, first[two], second[two])
        gone, kept = np.append(start[one], end[one]), np.append(end[one], start[one])
        here, there = (first[one], second[one]), (near, far)
        sides = np.stack([np.append(*ends) for ends in (here, here[::-1], there, there[::-1])])
        neighbours = csr_matrix((np.ones(len(gone), np.int8), (gone, kept)), shape=(count, count))
        distinct = np.unique(start * len(self.coordinate_parents) + first) // len(self.coordinate_parents)
        number = np.bincount(distinct, minlength=count)[gone]
        inside = (number == 1) & (sides[0] == sides[2]) & (sides[1] == sides[3])
        along = (number == 2) & (sides[0] != sides[2])
        free = ~fixed[gone] & (inside | along) & ~np.isin(gone * count + kept, self._refused)
        return gone[free], kept[free], sides[:, free], neighbours

    def _is_bad(self, gone: Indices, kept: Indices, neighbours: csr_matrix) -> NDArray[np.bool_]:
        """(M,) whether a collapse would make an edge with more than two triangles, or turn a triangle
        over."""
        common = neighbours[gone].multiply(neighbours[kept]).sum(axis=1)
        around = _incidence(self.triangles, self.poses.shape[1])
        which, triangle = _rows(around, gone)
        corners = self.triangles[triangle]
        stays = ~(corners == kept[which, None]).any(axis=1)
        which, corners = which[stays], corners[stays]
        moved = np.where(corners == gone[which, None], kept[which, None], corners)
        turned = np.zeros(len(which), bool)
        for vertices in self.poses:
            before, after = (_area_vectors(vertices[each]) for each in (corners, moved))
            sizes = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
            turned |= np.einsum("ij,ij->i", before, after) < _LEAST_COSINE * sizes
        return (np.asarray(common).ravel() != 2) | (np.bincount(which[turned], minlength=len(gone)) > 0)

    def _apply(self, gone: Indices, kept: Indices, sides: Indices) -> None:
        self.parents[gone] = kept
        vertices: Indices = np.arange(len(self.parents))
        vertices[gone] = kept
        coordinates: Indices = np.arange(len(self.coordinate_parents))
        for old, new in (sides[:2], sides[2:]):
            coordinates[old] = self.coordinate_parents[old] = new
        self.triangles, self.coordinates = _without_degenerate(
            vertices[self.triangles], coordinates[self.coordinates]
        )
        self._quadrics[:, kept] += self._quadrics[:, gone]
        self._areas[:, kept] += self._areas[:, gone]


def _without_degenerate(triangles: Indices, coordinates: Indices) -> _Triangles:
    a, b, c = triangles.T
    keep = (a != b) & (b != c) & (c != a)
    return triangles[keep], coordinates[keep]


def _followed(parents: Indices, stays: NDArray[np.bool_]) -> Indices:
    """(V,) vertex that each vertex collapses into in the end: its first ancestor that stays."""
    found = np.where(stays, np.arange(len(parents)), parents)
    while not stays[found].all() and not np.array_equal(
        further := np.where(stays[found], found, parents[found]), found
    ):
        found = further
    return found


def _incidence(triangles: Indices, count: int) -> csr_matrix:
    """(V, N) ones where a vertex is a corner of a triangle."""
    rows, columns = triangles.ravel(), np.repeat(np.arange(len(triangles)), 3)
    return csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, len(triangles)))


def _rows(matrix: csr_matrix, rows: Indices) -> tuple[Indices, Indices]:
    """Entries (M,) of some rows of a matrix: the position of the row in ``rows``, and the column."""
    sizes = np.diff(matrix.indptr)[rows]
    which = np.repeat(np.arange(len(rows)), sizes)
    offsets = np.arange(len(which)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return which, matrix.indices[np.repeat(matrix.indptr[rows], sizes) + offsets]


def _area_vectors(corners: Array) -> Array:
    """(M, 3) normals of triangles (M, 3, 3), times twice their areas."""
    return np.asarray(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), dtype=float)


def _deviations(poses: Array, triangles: Indices, vertices: Indices) -> Array:
    """(V,) largest distance of each vertex from a simplified surface of triangles (N, 3), in poses (P, V, 3).
    ``vertices``: (V,) remaining vertex that stands for each vertex. Distances are measured to triangles
    around that vertex, so that they are never too small."""
    removed = np.flatnonzero(vertices != np.arange(len(vertices)))
    around = _incidence(triangles, len(vertices))
    which, near = _rows((around @ (around.T @ around)).tocsr(), vertices[removed])
    found = np.zeros(len(vertices))
    for pose in poses:
        distances = _distances(pose[removed[which]], pose[triangles[near]])
        nearest = np.full(len(removed), np.inf)
        np.minimum.at(nearest, which, distances)
        found[removed] = np.maximum(found[removed], nearest)
    return found


def _distances(points: Array, corners: Array) -> Array:
    """Distances (M,) of points (M, 3) from triangles (M, 3, 3)."""
    a, b, c = corners.transpose(1, 0, 2)
    normal = _area_vectors(corners)
    square = np.maximum(_dot(normal, normal), 1e-30)
    weights = [_dot(np.cross(q - p, points - p), normal) for p, q in ((a, b), (b, c), (c, a))]
    inside = np.all([weight >= 0 for weight in weights], axis=0)
    edges = [_from_edge(points, p, q) for p, q in ((a, b), (b, c), (c, a))]
    plane = np.abs(_dot(points - a, normal)) / np.sqrt(square)
    return np.asarray(np.where(inside, plane, np.min(edges, axis=0)))


def _from_edge(points: Array, start: Array, end: Array) -> Array:
    line = end - start
    along = np.clip(_dot(points - start, line) / np.maximum(_dot(line, line), 1e-30), 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - start - along[:, None] * line, axis=1))


def _dot(left: Array, right: Array) -> Array:
    return np.asarray(np.einsum("ij,ij->i", left, right))


def compact(triangles: Indices) -> tuple[Indices, NDArray[np.int32]]:
    """Vertices (v,) that triangles use, and the triangles (N, 3) as indices into these vertices."""
    kept, inverse = np.unique(triangles, return_inverse=True)
    return kept, inverse.reshape(-1, 3).astype(np.int32)
