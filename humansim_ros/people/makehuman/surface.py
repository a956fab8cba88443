"""Body surface of the MakeHuman base mesh, its outlines, and the layout of its texture."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from itertools import chain, pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.ndimage import gaussian_filter, grey_closing, map_coordinates
from scipy.sparse import csgraph
from scipy.spatial import ConvexHull, cKDTree

from humansim_ros.files.mesh import mean_normals, rasterise_uv
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
    """Return the numbers (V,) of the vertices that faces use, sorted, and faces that index these vertices."""
    used = np.unique(faces)
    number = np.full(count, -1)
    number[used] = np.arange(len(used))
    return used, number[faces]


def sample(image: VertexMask, uv: Array) -> Array:
    """Values (T,) of the pixels of an image (H, W) that are nearest to uv (T, 2), v up."""
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


def smooth_towards(mean: sparse.csr_matrix, vertices: Array, amount: Array, rounds: int) -> Array:
    """Smooth vertices (V, 3) towards the mean of their neighbours.

    Args:
        mean: Matrix (V, V) of :func:`mean_matrix`.
        vertices: (V, 3).
        amount: Factor (V,) of each step, 0 to 1.
        rounds: Number of steps.
    """
    rows, out = np.flatnonzero(amount), vertices.copy()
    smooth_rows(mean[rows], out, rows, amount[rows, None], rounds)
    return out


def smooth_rows(mean: sparse.csr_matrix, out: Array, rows: VertexIndices, amount: Array, rounds: int) -> None:
    """Smooth some of the vertices (V, 3) in place.

    Args:
        mean: Rows (M, V) of the matrix of :func:`mean_matrix`.
        out: Vertices.
        rows: Numbers (M,) of the vertices that move.
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
    """Like :func:`noise`, but four times as fast, for paint. The noise repeats after 64 cells."""
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
            after = (k + 1) % 4
            edge = [quad[k], quad[after]]
            if tuple(sorted(edge)) in middles:
                first = len(ring)
                ring.append(middle(edge, middles, rows))
                uv_ring.append(middle([uv_quad[k], uv_quad[after]], uv_middles, uv_rows))
        if first < 0:
            faces.append(quad)
            uv_faces.append(uv_quad)
            continue
        for polygon, out in ((ring, faces), (uv_ring, uv_faces)):
            start, *others = polygon[first:] + polygon[:first]
            out += [[start, a, b, b] for a, b in pairwise(others)]

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
    columns = np.fromiter(chain.from_iterable(table), np.int64, int(sizes.sum()))
    starts = np.concatenate([[0], np.cumsum(sizes)])
    return sparse.csr_matrix((np.repeat(1 / sizes, sizes), columns, starts), shape=(len(table), count))


_HIGH, _WIDE = 0.008, np.radians(3.0)  # cell size: metres, radians


@dataclass(frozen=True)
class Outline:
    """Outline of a surface around a vertical axis: its largest distance ``reach`` (H, W) from the axis, in
    metres. The rows are heights, the columns directions. The axis is x = 0, z = ``axis``."""

    bottom: float
    axis: float
    reach: Array

    @classmethod
    def of(cls, vertices: Array, faces: VertexIndices, axis: float) -> Outline:
        """Measure the outline of a surface with vertices (V, 3), y up, and quads (F, 4) around the vertical
        axis at x = 0 and z = ``axis``, metres. Small gaps are closed, and the result is smoothed."""
        corners = vertices[faces]
        sides = [(corners[:, k] + corners[:, k - 1]) / 2 for k in range(4)]
        points = np.concatenate([vertices[np.unique(faces)], corners.mean(axis=1), *sides])
        bottom = float(points[:, 1].min())
        rows = ((points[:, 1] - bottom) / _HIGH).astype(int)
        columns = round(2 * np.pi / _WIDE)
        turn, reach = around(points, axis)
        grid = np.zeros((rows.max() + 1, columns))
        np.maximum.at(grid, (rows, (turn / _WIDE).astype(int) % columns), reach)
        padded = np.pad(np.pad(grid, ((3, 3), (0, 0)), "edge"), ((0, 0), (6, 6)), "wrap")
        smooth = gaussian_filter(grey_closing(padded, (5, 5)), 0.7)
        return cls(bottom, axis, smooth[3:-3, 6:-6])

    def hanging(self) -> Outline:
        """Outline of a surface that hangs down from this outline: nowhere narrower than at the heights
        above."""
        return replace(self, reach=np.maximum.accumulate(self.reach[::-1])[::-1])

    def at(self, points: Array) -> Array:
        """Reach (N,) at the height and in the direction of points (N, 3)."""
        row = ((points[:, 1] - self.bottom) / _HIGH - 0.5).clip(0, len(self.reach) - 1)
        column = around(points, self.axis)[0] / _WIDE - 0.5
        return np.asarray(map_coordinates(self._ring, np.stack([row, column + 1]), order=1, mode="nearest"))

    @functools.cached_property
    def _ring(self) -> Array:
        """``reach`` with W + 2 columns: the last one is repeated at the start, the first one at the end."""
        return np.pad(self.reach, ((0, 0), (1, 1)), "wrap")


def around(points: Array, axis: float) -> tuple[Array, Array]:
    """Direction (N,), 0 to two pi, and distance (N,) of points (N, 3) from the axis."""
    x, z = points[:, 0], points[:, 2] - axis
    return np.arctan2(x, z) % (2 * np.pi), np.hypot(x, z)


def shrink_onto(
    vertices: Array, mean: sparse.csr_matrix, free: Array, outline: Outline, rounds: int
) -> Array:
    """Smooth vertices (V, 3) towards the mean of their neighbours, but keep them outside an outline. Folded
    small faces spread over the surface.

    Args:
        vertices, mean, rounds: The same as in :func:`smooth_towards`.
        free: Mobility of each vertex, (V,), 0 to 1.
        outline: Outline that vertices stay outside of.
    """
    skin = vertices.copy()
    rows = np.flatnonzero(free > 0)
    mean, pull = mean[rows], 0.5 * free[rows, None]
    for _ in range(rounds):
        moved = skin[rows] + pull * (mean @ skin - skin[rows])
        skin[rows] = push_outwards(moved, outline.at(moved), outline.axis)
    return skin


def push_outwards(points: Array, reach: Array, axis: float) -> Array:
    """Move points (N, 3) away from the axis to at least ``reach`` (N,)."""
    distance = np.hypot(points[:, 0], points[:, 2] - axis)
    factor = np.maximum(reach / np.maximum(distance, 1e-6), 1.0)
    out = points.copy()
    out[:, 0] *= factor
    out[:, 2] = axis + (points[:, 2] - axis) * factor
    return out


TEXTURE_SIZE = 1024
# MakeHuman's layout gives the face a sixth of the width. Here clothes have less, and the face more:
# old -> new coordinates (u from the left, h = 1 - v from the top), monotone so that no island folds.
NARROW_U = ((0.0, 0.76), (0.0, 0.608))
HEAD_U = ((0.63, 0.80, 0.97, 1.0), (0.615, 0.735, 0.985, 0.998))
HEAD_H = ((0.17, 0.43, 0.60, 0.86), (0.008, 0.205, 0.585, 0.79))
HANDS_SHIFT = -0.064
EYE_BOX = 0.06


def _islands(uv_faces: VertexIndices, uv: Array) -> VertexIndices:
    """Island (T,) of each texture coordinate. Both points of a hem belong to the island around them."""
    island = csgraph.connected_components(neighbours(uv_faces, len(uv)), directed=False)[1]
    small = np.bincount(island)[island] < 3
    out = island.copy()
    out[small] = island[~small][cKDTree(uv[~small]).query(uv[small])[1]]
    return out


def relay_uv(uv: Array, uv_faces: VertexIndices, is_eye: NDArray[np.bool_]) -> Array:
    """Enlarge face and eyes in the texture. uv (T, 2), uv_faces (F, 4), is_eye (F,) -> uv (T, 2)."""
    u, h = uv[:, 0].copy(), 1 - uv[:, 1]
    island = _islands(uv_faces, uv)
    new_u, new_h = u.copy(), h.copy()
    eyes = np.unique(island[uv_faces[is_eye]])
    for number in np.unique(island):
        rows = island == number
        centre_u, centre_h = u[rows].mean(), h[rows].mean()
        if number in eyes:
            k = int(np.searchsorted(eyes, number))
            size = max(np.ptp(u[rows]), np.ptp(h[rows]))
            new_u[rows] = 0.73 + 0.065 * k + (u[rows] - u[rows].min()) / size * EYE_BOX
            new_h[rows] = 0.90 + (h[rows] - h[rows].min()) / size * EYE_BOX
        elif centre_u > 0.7 and centre_h < 0.85:  # head
            new_u[rows], new_h[rows] = np.interp(u[rows], *HEAD_U), np.interp(h[rows], *HEAD_H)
        elif centre_u > 0.75 and centre_h > 0.85:  # inside of the mouth
            new_u[rows] = 0.74 + 0.2 * (u[rows] - u[rows].min())
            new_h[rows] = 0.965 + 0.2 * (h[rows] - h[rows].min())
        elif centre_u > 0.4 and centre_h > 0.85:  # hands
            new_u[rows] = u[rows] + HANDS_SHIFT
        else:
            new_u[rows] = np.interp(u[rows], *NARROW_U)
    return np.c_[new_u, 1 - new_h]


@dataclass(frozen=True)
class Texels:
    """N texels of faces. ``face``: (N,) face of each texel. ``vertex``: (N,) first corner of its triangle.
    ``mixing``: (N, V) matrix that interpolates values of vertices. ``uv``: (N, 2) texture coordinates of the
    base mesh. ``nearest``: (S, S) nearest texel of every place of the texture."""

    face: VertexIndices
    vertex: VertexIndices
    mixing: sparse.csr_matrix
    uv: Array
    nearest: NDArray[np.int32]


def rasterise(mesh: BodySurface, uv: Array, size: int) -> Texels:
    """Find the triangle at the centre of each texel. ``uv``: texture coordinates (T, 2), v up. ``size``: side
    of the texture, texels."""
    fan = ([0, 1, 2], [0, 2, 3])
    triangles = np.concatenate([mesh.faces[:, c] for c in fan])
    uv_triangles = np.concatenate([mesh.uv_faces[:, c] for c in fan])
    found = rasterise_uv(uv, uv_triangles, size)
    count, number = len(found.triangle), found.triangle
    starts = np.arange(0, 3 * count + 1, 3)
    mixing, uv_mixing = (
        sparse.csr_matrix((found.weights.ravel(), corners[number].ravel(), starts), shape=(count, total))
        for corners, total in ((triangles, len(mesh.vertices)), (uv_triangles, len(uv)))
    )
    empty = np.ones((size, size), np.uint8)
    empty[found.row, found.column] = 0
    _, labels = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    texel = np.zeros(int(labels.max()) + 1, np.int32)
    texel[labels[found.row, found.column]] = np.arange(count)
    return Texels(number % len(mesh.faces), triangles[number, 0], mixing, uv_mixing @ mesh.uv, texel[labels])


def as_image(texels: Texels, colour: Array) -> NDArray[np.uint8]:
    """Texture of texel colours (N, ...). A raster with twice the resolution is reduced to half its size. Gaps
    get the colour of the nearest texel."""
    size = len(texels.nearest)
    if size > TEXTURE_SIZE:
        blocks = colour[texels.nearest].reshape(TEXTURE_SIZE, 2, TEXTURE_SIZE, 2, *colour.shape[1:])
        return np.clip(np.rint(blocks.mean(axis=(1, 3))), 0, 255).astype(np.uint8)
    return np.clip(np.rint(colour), 0, 255).astype(np.uint8)[texels.nearest]
