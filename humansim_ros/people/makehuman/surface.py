"""Body surface of the MakeHuman base mesh, and general surface operations."""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import ConvexHull

from humansim_ros.files.mesh import mean_normals
from humansim_ros.geometry import smooth_step
from humansim_ros.people.makehuman.data import VertexIndices, VertexMask
from humansim_ros.types import Array

NONE, SHOES, TROUSERS, SHIRT = range(4)  # in the order of layers


@dataclass(frozen=True)
class BodySurface:
    """Part of the base mesh that becomes a human. A triangle is a quad with a repeated last corner.

    vertices (V, 3), faces (F, 4), uv (T, 2) in the layout of the base mesh, uv_faces (F, 4), weights (V, B).
    canonical (V, 3): position on the naked reference body in the T pose. All bodies have the same topology,
    so clothes are cut and painted there for all. naked (V, 3): position on this naked body in the T pose.
    part (V,): 0 body, 1 left eye, 2 right eye. garment (V,) and face_garment (F,): NONE, SHIRT, TROUSERS or
    SHOES. weld (V,): number that both copies of a vertex at a hem share. The last ``hems`` faces are narrow
    strips between the edge of a garment and the surface below. shapes (V, 3 S): offsets of S actions of the
    face, in the A pose.
    """

    vertices: Array
    faces: VertexIndices
    uv: Array
    uv_faces: VertexIndices
    weights: Array
    canonical: Array
    naked: Array
    part: VertexIndices
    garment: VertexIndices
    face_garment: VertexIndices
    weld: VertexIndices
    shapes: Array
    hems: int = 0

    @property
    def surface(self) -> VertexIndices:
        """Faces (F - hems, 4) without the hems."""
        return self.faces[: len(self.faces) - self.hems]


def compact(faces: VertexIndices, count: int) -> tuple[VertexIndices, VertexIndices]:
    """Used vertices (V,), sorted, and the faces as indices into them."""
    used = np.unique(faces)
    number = np.full(count, -1)
    number[used] = np.arange(len(used))
    return used, number[faces]


def sample(image: VertexMask, uv: Array) -> Array:
    """Nearest values (T,) of an image (H, W) at uv (T, 2), v up."""
    height, width = image.shape[:2]
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    return image[row, column].astype(float)


def vertex_normals(vertices: Array, faces: VertexIndices) -> Array:
    """Area-weighted unit normals (N, 3) of quads (F, 4)."""
    a, b, c, d = (vertices[faces[:, k]] for k in range(4))
    return mean_normals(np.cross(c - a, d - b), faces, len(vertices))


def ramp(value: Array, low: float | Array, high: float | Array) -> Array:
    """Smooth step: 0 below low, 1 above high (or the reverse when high < low)."""
    return smooth_step((value - low) / (high - low))


def neighbours(faces: VertexIndices, count: int) -> sparse.csr_matrix:
    """Adjacency matrix (V, V) of the sides of quads (F, 4)."""
    edges = np.concatenate([faces[:, [k, (k + 1) % 4]] for k in range(4)])
    graph = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    return ((graph + graph.T) > 0).astype(float).tocsr()


def mean_matrix(graph: sparse.csr_matrix) -> sparse.csr_matrix:
    """Matrix (V, V) that gives each vertex the mean of its neighbours."""
    return (sparse.diags(1 / np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1)) @ graph).tocsr()


def smooth(vertices: Array, faces: VertexIndices, amount: Array, rounds: int) -> Array:
    """Smooth vertices in the same way as :func:`smooth_towards`.

    Args:
        vertices: (V, 3).
        faces: Quads (F, 4).
        amount: Factor (V,) of each step, 0 to 1.
        rounds: Number of steps.

    Returns:
        Vertices (V, 3).
    """
    return smooth_towards(mean_matrix(neighbours(faces, len(vertices))), vertices, amount, rounds)


def smooth_towards(mean: sparse.csr_matrix, vertices: Array, amount: Array, rounds: int) -> Array:
    """Smooth vertices towards the mean of their neighbours.

    Args:
        mean: Matrix (V, V) of :func:`mean_matrix`.
        vertices: (V, 3).
        amount: Factor (V,) of each step, 0 to 1.
        rounds: Number of steps.

    Returns:
        Vertices (V, 3).
    """
    rows, out = np.flatnonzero(amount), vertices.copy()
    smooth_rows(mean[rows], out, rows, amount[rows, None], rounds)
    return out


def smooth_rows(mean: sparse.csr_matrix, out: Array, rows: VertexIndices, amount: Array, rounds: int) -> None:
    """Smooth the rows (M,) of vertices (V, 3) in place.

    Args:
        mean: These rows (M, V) of the matrix of :func:`mean_matrix`.
        out: Vertices.
        rows: Rows that move.
        amount: Factor (M, 1) of each step.
        rounds: Number of steps.
    """
    for _ in range(rounds):
        out[rows] += amount * (mean @ out - out[rows])


#: Number of points with noise that is computed at once, so that arrays fit into the cache of a processor.
_CHUNK = 8192


def noise(points: Array, scale: float, seed: int) -> Array:
    """Smooth value noise (N,), -1 to 1, at points (N, 3), with features of about ``scale`` metres."""
    out = np.empty(len(points))
    for start in range(0, len(points), _CHUNK):
        out[start : start + _CHUNK] = _noise(points[start : start + _CHUNK], scale, seed)
    return out


def _noise(points: Array, scale: float, seed: int) -> Array:
    p = points.T / scale + 1000.0  # keep cells positive for the hash
    floor = np.floor(p)
    cell = floor.astype(np.int64).view(np.uint64)
    t = p - floor
    t *= t * (3 - 2 * t)
    factors = (np.uint64(73856093), np.uint64(19349663), np.uint64(83492791))
    keys = [(cell[k] * f, (cell[k] + np.uint64(1)) * f) for k, f in enumerate(factors)]
    keys[0] = (keys[0][0] + np.uint64(seed * 2654435761), keys[0][1] + np.uint64(seed * 2654435761))
    shares = [(1 - t[k], t[k]) for k in range(3)]
    total = np.zeros(len(points))
    for x in (0, 1):
        for y in (0, 1):
            edge, share = keys[0][x] + keys[1][y], shares[0][x] * shares[1][y]
            for z in (0, 1):
                value = _hashed(edge + keys[2][z])
                value *= share * shares[2][z]
                total += value
    return total


def _hashed(key: NDArray[np.uint64]) -> Array:
    """Pseudo-random numbers from -1 to 1, from keys. The keys are overwritten."""
    key *= np.uint64(0x9E3779B97F4A7C15)
    key ^= key >> np.uint64(29)
    key *= np.uint64(0xBF58476D1CE4E5B9)
    key >>= np.uint64(40)
    value: Array = key.view(np.int64) / 2.0**23
    value -= 1
    return value


#: Grain repeats in a cube. Its side has 2 ** _BITS cells.
_BITS = 6


def grain(points: Array, scale: float, seed: int) -> Array:
    """Like :func:`noise`, but it repeats after 64 cells. For paint; four times as fast."""
    table, last = _lattice(seed), (1 << _BITS) - 1
    out = np.empty(len(points))
    for start in range(0, len(points), _CHUNK):
        p = (points[start : start + _CHUNK].T / scale).astype(np.float32)
        floor = np.floor(p)
        t = p - floor
        t *= t * (3 - 2 * t)
        cell = floor.astype(np.int32)
        x, y, z = ((cell[axis] & last, (cell[axis] + 1) & last) for axis in range(3))
        planes = []
        for i in x:
            lines = []
            for j in y:
                line = ((i << _BITS) + j) << _BITS
                low = table[line + z[0]]
                lines.append(low + t[2] * (table[line + z[1]] - low))
            planes.append(lines[0] + t[1] * (lines[1] - lines[0]))
        out[start : start + _CHUNK] = planes[0] + t[0] * (planes[1] - planes[0])
    return out


@functools.lru_cache(maxsize=64)
def _lattice(seed: int) -> NDArray[np.float32]:
    """Values at the corners of the cells of :func:`grain`."""
    cells = np.arange(1 << (3 * _BITS), dtype=np.uint64)
    return _hashed((cells + np.uint64(1)) * np.uint64(73856093) + np.uint64(seed * 2654435761)).astype(
        np.float32
    )


def outline(points: Array, grow: float) -> Array:
    """Convex outline (K, 2) of points (N, 2), grown by ``grow`` metres."""
    hull = points[ConvexHull(points).vertices]
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rounded = (hull[:, None] + grow * np.c_[np.cos(angles), np.sin(angles)]).reshape(-1, 2)
    return rounded[ConvexHull(rounded).vertices]


def refine(mesh: BodySurface, chosen: NDArray[np.bool_]) -> tuple[BodySurface, sparse.csr_matrix]:
    """Subdivide the chosen quads (F,) into four, adapt their neighbours, and smooth the result. Returns the
    mesh, and the matrix (V', V) from the old vertices to the new ones."""
    # a new vertex is the mean of the old vertices in its row
    rows: list[list[int]] = [[i] for i in range(len(mesh.vertices))]
    uv_rows: list[list[int]] = [[i] for i in range(len(mesh.uv))]
    middles: dict[tuple[int, ...], int] = {}
    uv_middles: dict[tuple[int, ...], int] = {}

    def middle(of: list[int], known: dict[tuple[int, ...], int], table: list[list[int]]) -> int:
        key = tuple(sorted(of))
        if key not in known:
            known[key] = len(table)
            table.append(list(key))
        return known[key]

    faces: list[list[int]] = []
    uv_faces: list[list[int]] = []
    for quad, uv_quad in zip(mesh.faces[chosen].tolist(), mesh.uv_faces[chosen].tolist(), strict=True):
        for corners, known, table, out in (
            (quad, middles, rows, faces),
            (uv_quad, uv_middles, uv_rows, uv_faces),
        ):
            centre = middle(corners, known, table)
            sides = [middle([corners[k], corners[(k + 1) % 4]], known, table) for k in range(4)]
            out += [[corners[k], sides[k], centre, sides[k - 1]] for k in range(4)]
    for quad, uv_quad in zip(mesh.faces[~chosen].tolist(), mesh.uv_faces[~chosen].tolist(), strict=True):
        ring, uv_ring, first = [], [], -1
        for k in range(4):
            ring.append(quad[k])
            uv_ring.append(uv_quad[k])
            edge = (quad[k], quad[(k + 1) % 4])
            if tuple(sorted(edge)) in middles:
                first = len(ring)
                ring.append(middle(list(edge), middles, rows))
                uv_ring.append(middle([uv_quad[k], uv_quad[(k + 1) % 4]], uv_middles, uv_rows))
        if first < 0:
            faces.append(quad)
            uv_faces.append(uv_quad)
            continue
        for polygon, out in ((ring, faces), (uv_ring, uv_faces)):
            polygon = polygon[first:] + polygon[:first]
            out += [
                [polygon[0], polygon[k], polygon[k + 1], polygon[k + 1]] for k in range(1, len(polygon) - 1)
            ]

    new_faces, count = np.array(faces), len(rows)
    means, uv_means = (
        _mean_of_rows(table, len(old)) for table, old in ((rows, mesh.vertices), (uv_rows, mesh.uv))
    )
    scalp = np.zeros(count)
    scalp[np.unique(mesh.faces[chosen])] = 1.0
    scalp[len(mesh.vertices) :] = 1.0
    scalp[np.unique(mesh.faces[~chosen])] = 0.0  # the border stays in place
    pull, mean = sparse.diags(0.5 * scalp), mean_matrix(neighbours(new_faces, count))
    carry = means
    for _ in range(4):
        carry = (carry + pull @ (mean @ carry - carry)).tocsr()
    refined = BodySurface(
        vertices=carry @ mesh.vertices,
        faces=new_faces,
        uv=uv_means @ mesh.uv,
        uv_faces=np.array(uv_faces),
        weights=means @ mesh.weights,
        canonical=carry @ mesh.canonical,
        naked=carry @ mesh.naked,
        part=np.concatenate([mesh.part, np.zeros(count - len(mesh.part), int)]),
        garment=np.full(count, NONE),
        face_garment=np.full(len(new_faces), NONE),
        weld=np.arange(count),
        shapes=carry @ mesh.shapes,
    )
    return refined, carry


def _mean_of_rows(table: list[list[int]], count: int) -> sparse.csr_matrix:
    """Matrix (N, ``count``) that gives N means. Each row of the table lists the numbers that are averaged."""
    sizes = np.array([len(row) for row in table])
    columns = np.fromiter(itertools.chain.from_iterable(table), np.int64, int(sizes.sum()))
    starts = np.concatenate([[0], np.cumsum(sizes)])
    return sparse.csr_matrix((np.repeat(1 / sizes, sizes), columns, starts), shape=(len(table), count))
