"""Tessellation for lenses: OpenGL draws straight edges, a lens bends them.

Edges are halved until the middle of each is within a fraction of a pixel of its correct projection. The
decision depends on the two ends alone, so that triangles with a common edge stay connected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.camera.lens import Lens
from humansim_ros.types import Array, Indices

#: Error of an edge in pixels from which it is tessellated, and the error that tessellation leaves. The second
#: is smaller, because a lens bends all edges of a surface to one side, which shifts its image as a whole.
VISIBLE, TOLERANCE = 0.03, 0.01
#: The halves of an edge are accurate enough if its own error is below this multiple of the tolerance.
_ERROR_RATIO = 3.5
#: Longer edges, in pixels, are always halved: the error at the middle alone is not enough.
_MAX_LENGTH = 48.0
#: Pixels outside the image from which the error of an edge has no effect.
_OUTSIDE = 16.0
#: Tangent of the angle to the axis beyond which the tolerance grows with it: depth changes so fast there that
#: edges would become shorter than pixels.
_WIDE_TANGENT = 4.0
#: Largest length of edges over their distance: of those that cross the border of the field of view, and of
#: those beyond it.
_RIM, _BEYOND = 0.01, 0.1
#: Points along each side of the image at which the lens is sampled.
_GRID = 65
_ROUNDS, _MAX_TRIANGLES = 14, 4_000_000
#: Near plane in metres, also for wide lenses, and the tangent of the angle to the axis from which a lens is
#: wide: points beside the camera have a small depth at any distance.
NEAR, _WIDE_NEAR, _WIDE_LENS = 0.05, 0.005, 5.0


@dataclass(frozen=True)
class TessellatedMesh:
    """Vertex ``attributes`` (V, k), ``triangles`` (N, 3), and ``parents`` (N,): the original triangles."""

    attributes: Array
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
        """Lowest and highest x and y, (2,) each, of the image in the normalised image plane."""
        return self._field.low, self._field.high

    @property
    def near(self) -> float:
        """Near plane, metres."""
        widest = max(float(np.abs(bound).max()) for bound in self.bounds)
        return NEAR if widest < _WIDE_LENS else _WIDE_NEAR

    def straight_angle(self, low: tuple[int, int], high: tuple[int, int]) -> float:
        """Return the largest angle (radians) of edges without visible bend between pixels ``low`` and
        ``high``. The angle of an edge is its length over its distance.
        """
        bends = self._field.bends
        cells = np.maximum(np.array(self.camera.size) - 1, 1) / (_GRID - 1)
        x0, y0 = np.clip(np.floor(low / cells), 0, _GRID - 1).astype(int)
        x1, y1 = np.clip(np.ceil(high / cells), 0, _GRID - 1).astype(int) + 1
        bend = float(bends[y0:y1, x0:x1].max())
        return float(np.sqrt(8 * VISIBLE / max(bend, 1e-9)))

    def _sides_beyond(self, points: Array) -> NDArray[np.uint8]:
        """(V,) bit mask of the sides of the image that points (V, 3), optical frame, are beyond."""
        x, y, z = points.T
        (left, top), (right, bottom) = self.bounds
        beyond = [z < self.near, x < left * z, x > right * z, y < top * z, y > bottom * z]
        return np.packbits(beyond, axis=0)[0]

    def image_of(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Return the lowest and highest pixel, (2,) each, of a rectangle of the normalised image plane.

        They are inf and -inf if it is outside the image. ``low``, ``high``: (2,) corners of the rectangle.
        """
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

    def bent(self, starts: Array, ends: Array, *, tolerance: float = VISIBLE) -> NDArray[np.bool_]:
        """(E,) whether edges must be halved so that no error exceeds ``tolerance`` pixels.

        ``starts``, ``ends``: (E, 3) in the optical frame.
        """
        points = starts, ends, (starts + ends) / 2
        return self._bent(points, [self.camera.project_optical(p)[0] for p in points], tolerance)[0]

    def _bent(
        self, points: Sequence[Array], pixels: Sequence[Array], tolerance: float
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(E,) whether edges must be halved, and whether their halves are accurate without a test.

        ``points``: starts, ends and middles (E, 3), optical frame; ``pixels``: their projections (E, 2).
        """
        (start, end, middle), (a, b, m) = points, pixels
        visible_a, visible_b = np.isfinite(a[:, 0]), np.isfinite(b[:, 0])
        with np.errstate(invalid="ignore", divide="ignore"):
            za, zb = start[:, 2:], end[:, 2:]
            error = _length(m - (a * za + b * zb) / (za + zb))
            span = _length(a - b)
            outside: NDArray[np.bool_] = np.zeros(len(a), bool)
            for axis, side in enumerate(self.camera.size):
                p, q = a[:, axis], b[:, axis]
                outside |= (np.maximum(p, q) < -_OUTSIDE) | (np.minimum(p, q) > side + _OUTSIDE)
            allowed = tolerance * np.maximum(1.0, _length(middle[:, :2]) / (middle[:, 2] * _WIDE_TANGENT))
            bent = ((error > allowed) & ~outside) | (span > _MAX_LENGTH)
            enough = (error < _ERROR_RATIO * allowed) & (span < _MAX_LENGTH)
        if not (visible_a & visible_b).all():
            length, distance = _length(end - start), _length(start + end) / 2
            rim, beyond = length > _RIM * distance, length > _BEYOND * distance
            bent = np.where(visible_a & visible_b, bent, np.where(visible_a | visible_b, rim, beyond))
        return bent, enough

    def tessellate(
        self, attributes: Array, triangles: Indices, tolerance: float = TOLERANCE
    ) -> TessellatedMesh:
        """Tessellate triangles; those outside the image are left out.

        ``attributes``: (V, 3 + k) vertex attributes; the first three are the position in ``map``.
        ``triangles``: (N, 3). ``tolerance``: largest error of an edge in pixels.
        """
        corners, parents = triangles.astype(np.intp), np.arange(len(triangles), dtype=np.intp)
        # edges of the round: ends (E, 2), and the edges of the sides ab, bc, ca of each triangle, -1 for
        # straight sides
        sides = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        keys, inverse = np.unique(sides[:, 0] * len(attributes) + sides[:, 1], return_inverse=True)
        ends = np.stack([keys // len(attributes), keys % len(attributes)], axis=1)
        edges = inverse.reshape(-1, 3)
        points = self.camera.to_optical(attributes[:, :3])
        pixels, beyond = self.camera.project_optical(points)[0], self._sides_beyond(points)
        done, count = [(corners[:0], parents[:0])], 0
        for _ in range(_ROUNDS):
            a, b, c = beyond[corners].T
            inside = (a & b & c) == 0
            straight = inside & (np.bitwise_and.reduce(edges.T) < 0)  # all of them are -1
            done.append((corners[straight], parents[straight]))
            inside &= ~straight
            corners, edges, parents = corners[inside], edges[inside], parents[inside]
            count += len(corners)
            if not len(corners) or count > _MAX_TRIANGLES:
                break
            used = np.zeros(len(ends) + 1, bool)
            used[edges] = True
            tested = np.flatnonzero(used[:-1])
            first, second = ends[tested].T
            middles = (points[first] + points[second]) / 2
            projected = self.camera.project_optical(middles)[0]
            halved, enough = self._bent(
                (points[first], points[second], middles),
                (pixels[first], pixels[second], projected),
                tolerance,
            )
            cut, further = tested[halved], ~enough[halved]
            new = 2 * int(np.count_nonzero(further))
            # by edge; the last entry belongs to edge -1
            middle, half = np.full((2, len(ends) + 1), -1)
            middle[cut] = len(points) + np.arange(len(cut))
            half[cut[further]] = np.arange(0, new, 2)
            halves = _halves(corners, ends[edges], half[edges])
            pieces = _divided(corners, middle[edges], halves, new)
            start, end = ends[cut].T
            attributes = np.concatenate([attributes, (attributes[start] + attributes[end]) / 2])
            points = np.concatenate([points, middles[halved]])
            pixels = np.concatenate([pixels, projected[halved]])
            beyond = np.concatenate([beyond, self._sides_beyond(middles[halved])])
            between = np.repeat(middle[cut[further], None], 2, axis=1)
            ends = np.concatenate(
                [np.stack([ends[cut[further]], between], axis=2).reshape(-1, 2), pieces.within]
            )
            corners, edges, parents = pieces.corners, pieces.edges, parents[pieces.parts]
        done.append((corners, parents))
        return TessellatedMesh(attributes, *(np.concatenate(parts) for parts in zip(*done, strict=True)))

    def divide_edges(
        self, starts: NDArray[np.floating], ends: NDArray[np.floating]
    ) -> tuple[NDArray[np.floating], NDArray[np.floating], Indices]:
        """Divide edges (E, 3) in ``map`` into pieces (P, 3) that are straight in the image.

        Returns:
            Starts and ends of the pieces, and (P,) the edge of each.
        """
        done: list[tuple[NDArray[Any], NDArray[Any], Indices]] = []
        parents: Indices = np.arange(len(starts), dtype=np.intp)
        for _ in range(_ROUNDS):
            halved = self.bent(
                self.camera.to_optical(starts), self.camera.to_optical(ends), tolerance=TOLERANCE
            )
            done.append((starts[~halved], ends[~halved], parents[~halved]))
            starts, ends, parents = starts[halved], ends[halved], parents[halved]
            if not len(starts) or len(starts) > _MAX_TRIANGLES:
                break
            middles = (starts + ends) / 2
            starts, ends = np.concatenate([starts, middles]), np.concatenate([middles, ends])
            parents = np.tile(parents, 2)
        done.append((starts, ends, parents))
        starts, ends, parents = (np.concatenate(parts) for parts in zip(*done, strict=True))
        return starts, ends, parents


def near_plane(camera: Camera) -> float:
    """Return the near plane of a camera, metres."""
    return LensView(camera).near if camera.distorted else NEAR


@dataclass(frozen=True)
class _Field:
    """Field of view of a lens: bounds in the normalised image plane, and whether the image is partly dark.

    ``bends``: on a grid over the image, bend of a line in pixels per square of its angle (radians).
    """

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
    """(N,) of (N, k)."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))


def _halves(corners: Indices, ends: Indices, half: Indices) -> Indices:
    """(N, 3, 2) edges of the halves of the sides of triangles (N, 3), the half at the start of a side first.

    ``ends``: (N, 3, 2) of the edges of the sides. ``half``: (N, 3) edge of the half at the first end;
    the other half has the next edge; or -1.
    """
    turned = (ends[..., 0] != corners).astype(np.intp)
    both = np.stack([half + turned, half + 1 - turned], axis=2)
    return np.where(half[..., None] < 0, -1, both)


class _Pieces(NamedTuple):
    """``corners`` (P, 3) and ``edges`` (P, 3) of pieces; ``parts``: (P,) the triangle that each is from.

    ``within``: (E, 2) ends of the edges between the pieces of a triangle.
    """

    corners: Indices
    edges: Indices
    parts: Indices
    within: Indices


#: Pieces of a triangle by the number of its halved sides: corners, edges, and ends of the inner edges.
#: Corners: 0 1 2 (a b c), 3 4 5 (middles of ab bc ca). Edges: 0 straight, 1 to 6 halves of ab bc ca, 7 8 9
#: inner edges.
_CUTS: dict[int, tuple[list[tuple[int, int, int]], list[tuple[int, int, int]], list[tuple[int, int]]]] = {
    0: ([(0, 1, 2)], [(0, 0, 0)], []),
    # rotated so that ab is halved
    1: ([(0, 3, 2), (3, 1, 2)], [(1, 7, 0), (2, 0, 7)], [(3, 2)]),
    # rotated so that ca is not halved
    2: ([(3, 1, 4), (0, 3, 4), (0, 4, 2)], [(2, 3, 7), (1, 7, 8), (8, 4, 0)], [(3, 4), (0, 4)]),
    3: (
        [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)],
        [(1, 7, 6), (2, 3, 8), (9, 4, 5), (8, 9, 7)],
        [(3, 5), (3, 4), (4, 5)],
    ),
}


def _divided(corners: Indices, middles: Indices, halves: Indices, first: int) -> _Pieces:
    """Divide triangles.

    Args:
        corners: (N, 3) triangles.
        middles: (N, 3) vertices in the middle of the sides ab, bc, ca, or -1.
        halves: (N, 3, 2) edges of the halves of the sides.
        first: Number of the first inner edge.
    """
    count = (middles >= 0).sum(axis=1)
    turns = np.zeros(len(corners), np.intp)
    turns[count == 1] = np.argmax(middles[count == 1] >= 0, axis=1)
    turns[count == 2] = np.argmax(middles[count == 2] < 0, axis=1) + 1
    divided = []
    for number, (pieces, edges, within) in _CUTS.items():
        rows = np.flatnonzero(count == number)
        order = (np.arange(3) + turns[rows, None]) % 3
        at = rows[:, None]
        six = np.concatenate([corners[at, order], middles[at, order]], axis=1)
        new = first + np.arange(len(rows) * len(within), dtype=np.intp).reshape(len(rows), len(within))
        first += new.size
        ten = np.concatenate([np.full_like(at, -1), halves[at, order].reshape(-1, 6), new], axis=1)
        divided.append(
            _Pieces(
                six[:, pieces].reshape(-1, 3),
                ten[:, edges].reshape(-1, 3),
                np.repeat(rows, len(pieces)),
                six[:, np.reshape(within, (-1, 2)).astype(np.intp)].reshape(-1, 2),
            )
        )
    return _Pieces(*(np.concatenate(parts) for parts in zip(*divided, strict=True)))
