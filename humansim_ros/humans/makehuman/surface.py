"""Body surface of the MakeHuman base mesh, and general surface operations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import ConvexHull

from humansim_ros.humans.makehuman.data import VertexIndices, VertexMask
from humansim_ros.mesh.normals import mean_normals
from humansim_ros.types import Array

NONE, SHOES, TROUSERS, SHIRT = range(4)  # in the order of layers


@dataclass(frozen=True)
class BodySurface:
    """Part of the base mesh that becomes a human. Triangles are quads with a repeated last corner.

    vertices (V, 3), faces (F, 4), uv (T, 2) in the layout of the base mesh, uv_faces (F, 4), weights (V, B).
    canonical (V, 3): position on the naked reference body in the T pose. All bodies have the same topology,
    so clothes are cut and painted there for all.
    naked (V, 3): position on this naked body in the T pose.
    part (V,): 0 body, 1 left eye, 2 right eye. garment (V,) and face_garment (F,): NONE, SHIRT, TROUSERS or
    SHOES. weld (V,): equal for the copies of a vertex on the two sides of a hem. The last ``hems`` faces are
    narrow strips between the edge of a garment and the surface below. shapes (V, 3 S): offsets of S actions
    of the face, in the A pose.
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
    """Used rows (V,), sorted, and the renumbered faces."""
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
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def neighbours(faces: VertexIndices, count: int) -> sparse.csr_matrix:
    """Adjacency matrix (V, V) of the sides of quads (F, 4)."""
    edges = np.concatenate([faces[:, [k, (k + 1) % 4]] for k in range(4)])
    graph = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    return ((graph + graph.T) > 0).astype(float).tocsr()


def mean_matrix(graph: sparse.csr_matrix) -> sparse.csr_matrix:
    """Matrix (V, V) that gives each vertex the mean of its neighbours."""
    return (sparse.diags(1 / np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1)) @ graph).tocsr()


def smooth(vertices: Array, faces: VertexIndices, amount: Array, rounds: int) -> Array:
    """Smooth vertices towards the mean of their neighbours.

    Args:
        vertices: (V, 3).
        faces: Quads (F, 4).
        amount: Factor (V,) of each step, 0 to 1.
        rounds: Number of steps.

    Returns:
        Vertices (V, 3).
    """
    mean = mean_matrix(neighbours(faces, len(vertices)))
    for _ in range(rounds):
        vertices = vertices + amount[:, None] * (mean @ vertices - vertices)
    return vertices


def noise(points: Array, scale: float, seed: int) -> Array:
    """Smooth value noise (N,), -1 to 1, at points (N, 3), with features of about ``scale`` metres."""
    p = points / scale + 1000.0  # keep cells positive for the hash
    cell = np.floor(p).astype(np.uint64)
    t = p - cell
    t = t * t * (3 - 2 * t)
    factors = (np.uint64(73856093), np.uint64(19349663), np.uint64(83492791))
    keys = [(cell[:, k] * f, (cell[:, k] + np.uint64(1)) * f) for k, f in enumerate(factors)]
    shares = [(1 - t[:, k], t[:, k]) for k in range(3)]
    total = np.zeros(len(points))
    for corner in range(8):
        x, y, z = corner & 1, corner >> 1 & 1, corner >> 2
        key = keys[0][x] + keys[1][y] + keys[2][z] + np.uint64(seed * 2654435761)
        key *= np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
        key *= np.uint64(0xBF58476D1CE4E5B9)
        value = (key >> np.uint64(40)).astype(float) / 2**23 - 1
        total += value * (shares[0][x] * shares[1][y] * shares[2][z])
    return total


def outline(points: Array, grow: float) -> Array:
    """Convex outline (K, 2) of points (N, 2), grown by ``grow`` metres."""
    hull = points[ConvexHull(points).vertices]
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rounded = (hull[:, None] + grow * np.c_[np.cos(angles), np.sin(angles)]).reshape(-1, 2)
    return rounded[ConvexHull(rounded).vertices]


def refine(mesh: BodySurface, chosen: NDArray[np.bool_]) -> BodySurface:
    """Subdivide the chosen quads (F,) into four, adapt their neighbours, and smooth the result."""
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

    def means(values: Array, table: list[list[int]]) -> Array:
        return np.array([values[r].mean(axis=0) for r in table])

    vertices, canonical, naked = (means(v, rows) for v in (mesh.vertices, mesh.canonical, mesh.naked))
    new_faces = np.array(faces)
    scalp = np.zeros(len(vertices))
    scalp[np.unique(mesh.faces[chosen])] = 1.0
    scalp[len(mesh.vertices) :] = 1.0
    scalp[np.unique(mesh.faces[~chosen])] = 0.0  # the border stays in place
    bare, bare_faces = np.full(len(vertices), NONE), np.full(len(new_faces), NONE)
    return BodySurface(
        vertices=smooth(vertices, new_faces, 0.5 * scalp, 4),
        faces=new_faces,
        uv=means(mesh.uv, uv_rows),
        uv_faces=np.array(uv_faces),
        weights=means(mesh.weights, rows),
        canonical=smooth(canonical, new_faces, 0.5 * scalp, 4),
        naked=smooth(naked, new_faces, 0.5 * scalp, 4),
        part=np.concatenate([mesh.part, np.zeros(len(vertices) - len(mesh.part), int)]),
        garment=bare,
        face_garment=bare_faces,
        weld=np.arange(len(vertices)),
        shapes=smooth(means(mesh.shapes, rows), new_faces, 0.5 * scalp, 4),
    )
