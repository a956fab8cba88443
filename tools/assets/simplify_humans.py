"""Write the levels of detail of the built-in humans, ``assets/humans/levels``.

    python tools/assets/simplify_humans.py

Run it when a built-in human or ``LEVELS_VERSION`` of ``humansim_ros/people/loading/loading.py`` has changed.

Edges collapse into one of their vertices, so that the remaining vertices are a subset. Collapses with the
smallest quadric error [Garland 1997] come first. The error counts in several poses at once, so that a surface
that bends keeps its vertices at the bend. A vertex of a texture seam only moves along the seam. Borders stay.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from humansim_ros.cli.human import built_in_humans
from humansim_ros.files.mesh import Simplification, split_seams
from humansim_ros.files.mesh.mesh import followed, without_degenerate
from humansim_ros.files.reading import resource_root, write_npz
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.loading import LEVELS_ARRAYS, LEVELS_FOLDER, levels_path, load_human
from humansim_ros.types import Array, Indices

#: Number of triangles of each level, as a share of all triangles.
SHARES = (0.5, 0.35, 0.25, 0.18, 0.12, 0.08)
#: Number of poses in addition to the rest pose, and the angle (radians) by which each joint turns about a
#: random axis.
_POSES, _ANGLE = 3, 0.8
#: Share of the cheapest collapses that are tried in each round.
_TRIED = 0.35
#: Smallest cosine between the normals of a triangle before and after a collapse.
_LEAST_COSINE = 0.3
#: The error of a level holds for this share of the vertices: they deviate by at most this error.
_WITHIN = 0.95
_UPPER = np.triu_indices(4)
_TWICE = np.where(_UPPER[0] == _UPPER[1], 1.0, 2.0)


def main() -> None:
    folder = resource_root() / LEVELS_FOLDER
    folder.mkdir(exist_ok=True)
    for old in folder.glob("*.npz"):
        old.unlink()
    for name in built_in_humans():
        human = load_human(name)
        levels = make_levels(human)
        path = levels_path(human, folder)
        write_npz(
            path, {each: getattr(levels, each).astype(kind) for each, (_, kind) in LEVELS_ARRAYS.items()}
        )
        errors = ", ".join(f"{1e3 * error:.1f}" for error in levels.errors[1:])
        print(f"{name}: {path.stat().st_size / 1e3:.0f} kB, errors {errors} mm")


def make_levels(human: Human) -> Simplification:
    """Simplify a human; takes seconds."""
    return simplify(_poses(human), human.mesh.triangles, split_seams(human.mesh)[2], SHARES)


def _poses(human: Human) -> Array:
    """(P, V, 3) vertices in the rest pose, and with all joints turned at random."""
    bones = len(human.skeleton)
    axes = np.random.default_rng(0).normal(size=(_POSES, bones, 3))
    axes *= _ANGLE / np.linalg.norm(axes, axis=-1, keepdims=True)
    turns = Rotation.from_rotvec(axes.reshape(-1, 3)).as_quat().reshape(_POSES, bones, 4)
    bent = [human.pose(human.skeleton.pose(turn)) for turn in turns]
    return np.stack([human.mesh.vertices, *bent]).astype(float)


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
        final = followed(work.parents, removed_at == 255)
        errors.append(float(np.quantile(_deviations(poses, work.triangles, final), _WITHIN)))
    return Simplification(work.parents, work.coordinate_parents, removed_at, np.array(errors))


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

    def collapse(self, goal: int) -> bool:
        """Do one round: collapse the cheapest edges, but stop at about ``goal`` triangles. Returns False if
        no edge is left to try."""
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
        best = best[cost[best] <= np.quantile(cost[best], _TRIED)]
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
        self.triangles, self.coordinates = without_degenerate(
            vertices[self.triangles], coordinates[self.coordinates]
        )
        self._quadrics[:, kept] += self._quadrics[:, gone]
        self._areas[:, kept] += self._areas[:, gone]


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


if __name__ == "__main__":
    main()
