"""Tessellation for lenses: OpenGL draws straight edges, but a lens bends them.

Edges are divided into short pieces, so that the middle of each piece is within a fraction of a pixel of its
correct projection. The number of pieces depends only on the two ends, so that triangles with a common edge
stay connected.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera, Lens
from humansim_ros.types import Array, Indices

#: A number larger than any number of pieces of an edge.
_MANY = 1 << 10
#: A point of a pattern: its group and its number in the group.
_Point = tuple[int, int]


class TriangleEdges(NamedTuple):
    """Distinct edges of N triangles. ``ends``: (E, 2) vertices of each edge, the lower number first.
    ``sides``: (N, 3) number of the edge at the sides ab, bc and ca of each triangle."""

    ends: Indices
    sides: Indices

    @classmethod
    def of(cls, corners: Indices, count: int) -> TriangleEdges:
        """Find the distinct edges of triangles (N, 3). ``count``: number of vertices."""
        following = np.roll(corners, -1, axis=1)
        keys = np.minimum(corners, following) * count + np.maximum(corners, following)
        distinct, sides = np.unique(keys, return_inverse=True)
        return cls(np.stack(np.divmod(distinct, max(count, 1)), axis=1), sides.reshape(-1, 3))


def divide_triangles(
    attributes: NDArray[Any], corners: Indices, edges: TriangleEdges, pieces: Indices
) -> tuple[NDArray[Any], Indices, Indices]:
    """Divide triangles so that each edge has the given number of pieces.

    Args:
        attributes: (V, k) attributes of vertices.
        corners: (N, 3) triangles.
        edges: Edges of the triangles.
        pieces: (E,) number of pieces of each edge.

    Returns:
        Attributes of old and new vertices; (T, 3) new triangles; (T,) original triangle of each new triangle.
    """
    edge, number = _numbered(pieces - 1)
    starts, ends = (attributes[column[edge]] for column in edges.ends.T)
    on_edges = _between(starts, ends, pieces[edge], number + 1)
    # rotate so that bc has the fewest pieces: the rows of a pattern are parallel to bc
    order = (np.arange(3) + pieces[edges.sides].argmin(axis=1)[:, None] + 2) % 3
    corners, sides = (np.take_along_axis(one, order, axis=1) for one in (corners, edges.sides))
    distinct, kind = np.unique(pieces[sides] @ [_MANY * _MANY, _MANY, 1], return_inverse=True)
    patterns = [_pattern(key // _MANY**2, key // _MANY % _MANY, key % _MANY) for key in distinct.tolist()]
    inside, of_inside = _entries([len(pattern.weights) for pattern in patterns], kind)
    weights = np.concatenate([np.zeros((0, 3)), *(pattern.weights for pattern in patterns)])[of_inside]
    inner = np.zeros((len(inside), attributes.shape[1]), attributes.dtype)
    for weight, corner in zip(weights.astype(attributes.dtype).T, corners.T, strict=True):
        inner += weight[:, None] * attributes[corner[inside]]
    # the points of each triangle: its corners, points on its sides, inner points
    first, step = np.zeros((2, len(corners), 7), np.intp)
    first[:, :3] = corners
    forward = edges.ends[sides, 0] == corners
    of_edge = len(attributes) + np.cumsum(pieces - 1) - (pieces - 1)
    first[:, 3:6] = of_edge[sides] + np.where(forward, 0, pieces[sides] - 2)
    step[:, 3:6] = np.where(forward, 1, -1)
    first[:, 6] = len(attributes) + len(on_edges) + np.searchsorted(inside, np.arange(len(corners)))
    step[:, 6] = 1
    owner, of_points = _entries([pattern.points.shape[1] for pattern in patterns], kind)
    group, number = np.concatenate([np.zeros((2, 0), np.intp), *(one.points for one in patterns)], axis=1)[
        :, of_points
    ]
    group += 7 * owner
    points = first.ravel()[group] + step.ravel()[group] * number
    return np.concatenate([attributes, on_edges, inner]), points.reshape(-1, 3), owner[::3]


def _entries(counts: list[int], kind: Indices) -> tuple[Indices, Indices]:
    """List the P entries of N owners, owner by owner. An owner of kind k has ``counts[k]`` entries. Returns
    the owner (P,) of each entry, and its number (P,) in the joined list of all kinds."""
    number_of = np.array(counts, np.intp)
    owner, number = _numbered(number_of[kind])
    return owner, (np.cumsum(number_of) - number_of)[kind[owner]] + number


def divide_edges(
    starts: NDArray[Any], ends: NDArray[Any], pieces: Indices
) -> tuple[NDArray[Any], NDArray[Any], Indices]:
    """Divide edges from ``starts`` to ``ends``, (E, k), into equal ``pieces`` (E,).

    Returns:
        Starts and ends (P, k) of the pieces, and the number (P,) of the edge that each piece is part of.
    """
    edge, number = _numbered(pieces)
    whole = starts[edge], ends[edge], pieces[edge]
    return _between(*whole, number), _between(*whole, number + 1), edge


def _numbered(counts: Indices) -> tuple[Indices, Indices]:
    """List ``counts`` (E,) items for each of E owners, owner by owner. Returns for each item the number of
    its owner, and its own number (from 0) in that owner."""
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - (np.cumsum(counts) - counts)[owner]


def _between(starts: NDArray[Any], ends: NDArray[Any], pieces: Indices, number: Indices) -> NDArray[Any]:
    """Divide edges into equal ``pieces`` (P,). Returns the points (P, k) at the end of the first ``number``
    (P,) pieces. The result is bit-identical if start and end are exchanged."""
    before, after = ((n / pieces).astype(starts.dtype)[:, None] for n in (number, pieces - number))
    return np.asarray(starts * after + ends * before)


class _Pattern(NamedTuple):
    """How a triangle a b c is divided into T new triangles. ``points``: (2, 3 T) group and number (in the
    group) of the corners of the new triangles. The groups are a, b, c, the points within ab, bc and ca, and
    inner points with barycentric ``weights`` (I, 3)."""

    points: Indices
    weights: Array


@lru_cache(maxsize=4096)
def _pattern(ab: int, bc: int, ca: int) -> _Pattern:
    """Divide a triangle with ``ab``, ``bc`` and ``ca`` pieces on its sides. Points lie on rows that run from
    ab to ca, parallel to bc. New triangles fill the strips between rows. Their shape is chosen for a triangle
    with sides of lengths ``ab``, ``bc`` and ``ca``, so that all pieces have length 1."""
    rows = max(ab, ca)
    x = (ab * ab - bc * bc + ca * ca) / (2 * ab)
    b, c = complex(ab), complex(x, np.sqrt(max(ca * ca - x * x, 0.25)))
    on_ab = [(0, 0), *((3, number) for number in range(ab - 1)), (1, 0)]
    on_bc = [(1, 0), *((4, number) for number in range(bc - 1)), (2, 0)]
    on_ac = [(0, 0), *((5, number) for number in reversed(range(ca - 1))), (2, 0)]
    places = {point: b * number / ab for number, point in enumerate(on_ab)}
    places |= {point: b + (c - b) * number / bc for number, point in enumerate(on_bc)}
    places |= {point: c * number / ca for number, point in enumerate(on_ac)}
    points: list[tuple[int, int]] = []
    weights: list[tuple[float, float, float]] = []
    above = [(0, 0)]
    for row in range(1, rows + 1):
        below = on_bc
        if row < rows:
            left, right = -(-row * ab // rows), -(-row * ca // rows)
            low, high = places[on_ab[left]], places[on_ac[right]]
            pieces = min(bc, max(1, int(np.ceil(abs(high - low) - 0.01))))
            below = [on_ab[left]]
            for share in (number / pieces for number in range(1, pieces)):
                below.append((6, len(weights)))
                places[below[-1]] = low + (high - low) * share
                of_b, of_c = (1 - share) * left / ab, share * right / ca
                weights.append((1 - of_b - of_c, of_b, of_c))
            below.append(on_ac[right])
        for triangle in _strip(above, below, places):
            points += triangle
        above = below
    return _Pattern(np.array(points, np.intp).T, np.array(weights, float).reshape(-1, 3))


def _strip(
    above: list[_Point], below: list[_Point], places: dict[_Point, complex]
) -> list[tuple[_Point, _Point, _Point]]:
    """Fill the strip between two rows of points with triangles. Where two diagonals are possible, the shorter
    one is used. ``places``: positions of the points as complex numbers."""
    triangles, i, j = [], 0, 0
    while i + 1 < len(above) or j + 1 < len(below):
        lower = i + 1 == len(above)
        if not lower and j + 1 < len(below):
            diagonals = (places[above[i]] - places[below[j + 1]], places[above[i + 1]] - places[below[j]])
            lower = abs(diagonals[0]) <= abs(diagonals[1])
        if lower:
            triangles.append((above[i], below[j], below[j + 1]))
            j += 1
        else:
            triangles.append((above[i], below[j], above[i + 1]))
            i += 1
    return [triangle for triangle in triangles if len(set(triangle)) == 3]


#: An edge is tessellated if its error is larger than ``VISIBLE``, pixels. Then the error is at most
#: ``TOLERANCE``. This is smaller, since a lens bends all edges of a surface to one side, which shifts its
#: whole image.
VISIBLE, TOLERANCE = 0.03, 0.01
#: An edge that is longer than this, pixels, or along which the depth grows by a larger factor than this, is
#: divided first, since its error cannot be estimated.
_MAX_LENGTH, _MAX_RATIO = 48.0, 2.0
#: Factor of the number of pieces of an edge, since edges inside a divided triangle are longer than on its
#: sides.
_SAFETY = 1.2
#: Beyond this tangent of the angle to the axis, the tolerance grows with the tangent. Depth changes so fast
#: there that edges would become shorter than pixels.
_WIDE_TANGENT = 4.0
#: Largest ratio of length to distance for edges that cross the border of the field of view, and for edges
#: beyond it.
_RIM, _BEYOND = 0.01, 0.1
#: Points along each side of the image at which the lens is sampled.
_GRID = 65
#: Largest number of pieces of an edge of a triangle.
_MAX_PIECES = 32
#: Most rounds in which long edges are divided, most pieces in each round, and the number of triangles that
#: limits both.
_ROUNDS, _MAX_CUT, _MAX_TRIANGLES = 8, 16, 4_000_000
#: Near plane for usual lenses and for wide lenses, metres. A lens is wide if it sees beyond this tangent of
#: the angle to the axis: points at the side of the camera have a small depth at any distance.
NEAR, _WIDE_NEAR, _WIDE_LENS = 0.05, 0.005, 5.0


@dataclass(frozen=True)
class TessellatedMesh:
    """A mesh after tessellation: vertex ``attributes`` (V, k), new ``triangles`` (N, 3), and ``parents``
    (N,), the original triangle of each new triangle."""

    attributes: NDArray[np.floating]
    triangles: Indices
    parents: Indices


@dataclass(frozen=True, eq=False)
class LensView:
    """Field of view and distortion of a camera's lens."""

    camera: Camera

    @cached_property
    def _field(self) -> _Field:
        camera = self.camera
        return _field(camera.lens, camera.size, tuple(camera.K.ravel().tolist()))

    @property
    def partly_dark(self) -> bool:
        """Whether some pixels are beyond the field of view of the lens."""
        return self._field.partly_dark

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lowest (x, y) and highest (x, y) of the image in the normalised image plane."""
        return self._field.low, self._field.high

    @property
    def near(self) -> float:
        """Near plane, metres."""
        widest = max(float(np.abs(bound).max()) for bound in self.bounds)
        return NEAR if widest < _WIDE_LENS else _WIDE_NEAR

    def straight_angle(self, low: tuple[int, int], high: tuple[int, int]) -> float:
        """Return the angle (radians) within which edges between pixels ``low`` and ``high`` look straight.
        The angle of an edge is its length divided by its distance."""
        bends = self._field.bends
        cells = np.maximum(np.array(self.camera.size) - 1, 1) / (_GRID - 1)
        x0, y0 = np.clip(np.floor(low / cells), 0, _GRID - 1).astype(int)
        x1, y1 = np.clip(np.ceil(high / cells), 0, _GRID - 1).astype(int) + 1
        bend = float(bends[y0:y1, x0:x1].max())
        return float(np.sqrt(8 * VISIBLE / max(bend, 1e-9)))

    def _sides_beyond(self, points: Array) -> NDArray[np.uint8]:
        """(V,) bit mask of the sides of the image that each point (V, 3), in the optical frame, is beyond."""
        x, y, z = points.T
        (left, top), (right, bottom) = self.bounds
        beyond = [z < self.near, x < left * z, x > right * z, y < top * z, y > bottom * z]
        return np.packbits(beyond, axis=0)[0]

    def image_of(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Return the lowest and highest pixel, (2,) each, of a rectangle of the normalised image plane. They
        are inf and -inf if the rectangle is outside the image. ``low``, ``high``: (2,) corners of the
        rectangle."""
        nothing = np.full(2, np.inf), np.full(2, -np.inf)
        low, high = np.maximum(low, self._field.low), np.minimum(high, self._field.high)
        if not (low < high).all():
            return nothing
        x, y = (np.linspace(a, b, 33) for a, b in zip(low, high, strict=True))
        n = _border(x, y)
        reach = self.camera.lens.valid_radius * (1 - 1e-9)
        n *= np.minimum(1.0, reach / np.maximum(np.linalg.norm(n, axis=1), 1e-12))[:, None]
        k = self.camera.K
        pixels = self.camera.lens.distort(n) @ k[:2, :2].T + k[:2, 2]
        return pixels.min(axis=0) - 1, pixels.max(axis=0) + 1

    def bent(self, starts: Array, ends: Array, tolerance: float) -> NDArray[np.bool_]:
        """(E,) whether each edge bends by more than a tolerance in pixels, or is so long that it may.
        ``starts``, ``ends``: (E, 3) metres in ``map``."""
        a, b = self._projected(starts), self._projected(ends)
        return (self._cuts(a, b) > 1) | (self._pieces(a, b, tolerance) > 1)

    def _projected(self, positions: NDArray[np.floating]) -> _Projected:
        points = self.camera.to_optical(positions)
        return _Projected(points, self.camera.project_optical(points)[0], self._sides_beyond(points))

    def _cuts(self, a: _Projected, b: _Projected) -> Indices:
        """(E,) number of pieces for edges that are too long to estimate their error. It is 1 for other
        edges."""
        seen = np.isfinite(a.pixels[:, 0]).astype(np.intp) + np.isfinite(b.pixels[:, 0])
        with np.errstate(invalid="ignore", divide="ignore"):
            za, zb = a.points[:, 2], b.points[:, 2]
            ratio = np.maximum(
                _length(a.pixels - b.pixels) / _MAX_LENGTH, np.maximum(za / zb, zb / za) / _MAX_RATIO
            )
        if not (seen == 2).all():
            distance = np.maximum(_length(a.points + b.points) / 2, 1e-9)
            share = _length(a.points - b.points) / distance
            ratio = np.where(seen == 2, ratio, share / np.where(seen == 1, _RIM, _BEYOND))
        return np.ceil(np.clip(ratio, 1, _MAX_CUT)).astype(np.intp)

    def _pieces(self, a: _Projected, b: _Projected, tolerance: float) -> Indices:
        """(E,) number of pieces for edges that are not too long, so that no error exceeds ``tolerance``
        pixels."""
        pieces = np.ones(len(a.points), np.intp)
        tested = np.flatnonzero(np.isfinite(a.pixels[:, 0]) & np.isfinite(b.pixels[:, 0]))
        a, b = a.take(tested), b.take(tested)
        middle = self._between(a, b)
        wide = _length(middle.points[:, :2]) / (middle.points[:, 2] * _WIDE_TANGENT)
        allowed = tolerance * np.maximum(1.0, wide)
        bent = np.flatnonzero(_error(a, middle, b) > allowed)
        a, b, middle = a.take(bent), b.take(bent), middle.take(bent)
        half = np.maximum(*(_error(one, self._between(one, middle), middle) for one in (a, b)))
        # the error falls with the square of the length
        needed = np.maximum(2 * _SAFETY * np.sqrt(half / allowed[bent]), 2)
        pieces[tested[bent]] = np.ceil(np.minimum(needed, _MAX_PIECES)).astype(np.intp)
        return pieces

    def _between(self, a: _Projected, b: _Projected) -> _Projected:
        """Points in the middle of edges. Their bits ``beyond`` are not computed."""
        points = (a.points + b.points) / 2
        return _Projected(points, self.camera.project_optical(points)[0], a.beyond)

    def tessellate(
        self,
        attributes: NDArray[np.floating],
        triangles: NDArray[np.integer],
        tolerance: float = TOLERANCE,
        checked: bool = False,
    ) -> TessellatedMesh:
        """Tessellate triangles. Triangles outside the image are left out.

        Args:
            attributes: (V, 3 + k) vertex attributes; the first three are the position in ``map``.
            triangles: (N, 3) vertices.
            tolerance: Largest error of an edge in pixels. Up to three of a hundred edges inside triangles
                have a larger error.
            checked: Divide the edges with a larger error once more. This takes several times as long.
        """
        corners, parents = triangles.astype(np.intp), np.arange(len(triangles), dtype=np.intp)
        vertices = self._projected(attributes[:, :3])
        short = [(corners[:0], parents[:0])]
        for _ in range(_ROUNDS):
            inside = np.bitwise_and.reduce(vertices.beyond[corners], axis=1) == 0
            corners, parents = corners[inside], parents[inside]
            edges = TriangleEdges.of(corners, len(attributes))
            cuts = self._cuts(*vertices.ends(edges))
            long = (cuts[edges.sides] > 1).any(axis=1)
            short.append((corners[~long], parents[~long]))
            corners, parents = corners[long], parents[long]
            if not 0 < len(corners) < _MAX_TRIANGLES:
                break
            edges = edges._replace(sides=edges.sides[long])
            attributes, corners, sources = divide_triangles(attributes, corners, edges, cuts)
            parents = parents[sources]
            vertices = vertices.followed_by(self._projected(attributes[len(vertices.points) :, :3]))
        short.append((corners, parents))
        corners, parents = (np.concatenate(parts) for parts in zip(*short, strict=True))
        for _ in range(1 + checked):
            vertices = vertices.followed_by(self._projected(attributes[len(vertices.points) :, :3]))
            edges = TriangleEdges.of(corners, len(attributes))
            pieces = self._pieces(*vertices.ends(edges), tolerance)
            count = float(np.sort(pieces[edges.sides], axis=1)[:, 1:].prod(axis=1).sum())
            if count > _MAX_TRIANGLES:
                pieces = np.maximum(pieces * np.sqrt(_MAX_TRIANGLES / count), 1).astype(np.intp)
            attributes, corners, sources = divide_triangles(attributes, corners, edges, pieces)
            parents = parents[sources]
        return TessellatedMesh(attributes, corners, parents)

    def divide_edges(
        self, starts: NDArray[np.floating], ends: NDArray[np.floating], tolerance: float = TOLERANCE
    ) -> tuple[NDArray[np.floating], NDArray[np.floating], Indices]:
        """Divide edges (E, 3) in ``map`` into pieces (P, 3) that look straight. Edges outside the image are
        left out.

        Returns:
            Starts and ends of the pieces, and the number (P,) of the edge that each piece is part of.
        """
        divided, parents = [], np.arange(len(starts), dtype=np.intp)
        for number in range(_ROUNDS + 1):
            a, b = self._projected(starts), self._projected(ends)
            inside = (a.beyond & b.beyond) == 0
            cuts = self._cuts(a, b)
            long = inside & (cuts > 1)
            last = number == _ROUNDS or not long.any() or len(starts) > _MAX_TRIANGLES
            short = np.flatnonzero(inside if last else inside & ~long)
            pieces = self._pieces(a.take(short), b.take(short), tolerance)
            *ends_of, edge = divide_edges(starts[short], ends[short], pieces)
            divided.append((*ends_of, parents[short[edge]]))
            if last:
                break
            starts, ends, edge = divide_edges(starts[long], ends[long], cuts[long])
            parents = parents[long][edge]
        starts, ends, parents = (np.concatenate(parts) for parts in zip(*divided, strict=True))
        return starts, ends, parents


class _Projected(NamedTuple):
    """Points that a lens has projected. ``points``: (V, 3) in the optical frame. ``pixels``: (V, 2).
    ``beyond``: (V,) bit mask of the sides of the image that each point is beyond."""

    points: Array
    pixels: Array
    beyond: NDArray[np.uint8]

    def take(self, which: Indices) -> _Projected:
        return _Projected(self.points[which], self.pixels[which], self.beyond[which])

    def followed_by(self, other: _Projected) -> _Projected:
        return _Projected(
            np.concatenate([self.points, other.points]),
            np.concatenate([self.pixels, other.pixels]),
            np.concatenate([self.beyond, other.beyond]),
        )

    def ends(self, edges: TriangleEdges) -> tuple[_Projected, _Projected]:
        """Starts and ends of edges."""
        start, end = edges.ends.T
        return self.take(start), self.take(end)


def _error(a: _Projected, middle: _Projected, b: _Projected) -> Array:
    """(E,) pixels between the projected middle of each edge and the middle of the line that OpenGL draws."""
    za, zb = a.points[:, 2:], b.points[:, 2:]
    with np.errstate(invalid="ignore", divide="ignore"):
        return _length(middle.pixels - (a.pixels * za + b.pixels * zb) / (za + zb))


def near_plane(camera: Camera) -> float:
    """Return the near plane of a camera, metres."""
    return LensView(camera).near if camera.distorted else NEAR


@dataclass(frozen=True)
class _Field:
    """Field of view of a lens: its bounds in the normalised image plane. ``dark``: some pixels are beyond the
    field of view. ``bends``: for a grid over the image, the bend of a short line in pixels, divided by the
    square of the angle that the line spans (radians)."""

    low: Array
    high: Array
    partly_dark: bool
    bends: Array


@lru_cache(maxsize=64)
def _field(lens: Lens, size: tuple[int, int], k: tuple[float, ...]) -> _Field:
    camera = Camera(size, np.reshape(k, (3, 3)), np.eye(3), np.zeros(3), lens.coefficients, lens.model)
    x, y = (np.linspace(-0.5, n - 0.5, _GRID, dtype=float) for n in size)
    rim = camera.rays(_border(x, y))[:, :2]
    dark = bool(np.isnan(rim).any())
    low, high = rim.min(axis=0), rim.max(axis=0)
    if dark:  # the border of the field of view is inside the image
        low, high = np.full(2, -lens.valid_radius), np.full(2, lens.valid_radius)
    n = camera.rays(np.stack(np.meshgrid(x, y), axis=-1))[..., :2]
    spread = 1 + np.einsum("...i,...i->...", n, n)
    step = 1e-4 * spread[..., None]
    second = np.zeros(n.shape[:-1])
    for axis in np.eye(2):
        change = lens.jacobian(n + step * axis) - lens.jacobian(n - step * axis)
        second += ((change / (2 * step[..., None])) ** 2).sum(axis=(-1, -2))
    bends = np.nan_to_num(np.sqrt(second) * spread**2) * float(np.abs(camera.K[:2, :2]).max())
    for array in (low, high, bends):
        array.setflags(write=False)
    return _Field(low, high, dark, bends)


def _border(x: Array, y: Array) -> Array:
    """Points (P, 2) on the sides of a rectangle; ``x``, ``y``: ascending coordinates."""
    across, down = np.ones_like(x), np.ones_like(y)
    sides = [(x, y[0] * across), (x, y[-1] * across), (x[0] * down, y), (x[-1] * down, y)]
    return np.concatenate([np.stack(side, axis=1) for side in sides])


def _length(vectors: Array) -> Array:
    """Lengths (N,) of vectors (N, k)."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))
