"""Triangles cut so small that a lens may bend their edges: between vertices all lines drawn are straight.

Edges are halved until their middles fall within a fraction of a pixel of where they would be drawn. That an
edge is halved depends on its two ends alone, so that triangles which share one stay together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.camera.lens import Lens
from humansim_ros.types import Array, Indices

#: Pixels that an edge may be away from where it should be; and, where edges are cut, how near they come: all
#: lines of a surface are bent to one side, so that what is left of it shifts its picture as a whole.
VISIBLE, TOLERANCE = 0.03, 0.01
#: The halves of an arc that is off by less than so many times the tolerance surely are near enough.
_SURELY = 3.5
#: Edges longer than so many pixels are halved anyway: their middle alone says too little.
_LONGEST = 48.0
#: Beside the image by so many pixels it does not matter how edges shorter than that are drawn.
_BESIDE = 16.0
#: Beyond this tangent of the angle to the axis edges may be off by more, as it grows: depth changes so fast
#: there that edges would become shorter than pixels.
_FAR_OFF = 4.0
#: Edges at the rim of what the lens sees are cut down to this share of their distance.
_RIM, _BEYOND = 0.01, 0.1
#: Points along each side of the image at which the lens is looked at.
_GRID = 65
_ROUNDS, _MAX_TRIANGLES = 14, 4_000_000
#: Metres along the axis within which nothing is drawn; and for lenses that see farther off the axis than this
#: tangent: what is beside a camera is far away, and yet its depth is small.
NEAR, _NEAR_BESIDE, _BESIDE_FROM = 0.05, 0.005, 5.0


@dataclass(frozen=True)
class TessellatedMesh:
    """``attributes`` (V, k), ``triangles`` (N, 3) of them, ``parents`` (N,): what these are parts of."""

    attributes: Array
    triangles: Indices
    parents: Indices


@dataclass(frozen=True, eq=False)
class LensView:
    """How much a camera's lens bends straight lines, and what it sees at all."""

    camera: Camera

    @cached_property
    def _field(self) -> _Field:
        camera = self.camera
        return _field(camera.lens, camera.size, tuple(camera.K.ravel().tolist()))

    @property
    def partly_dark(self) -> bool:
        """Whether the lens leaves pixels of the image dark."""
        return self._field.partly_dark

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest x and y of the normalised image plane that the image can show."""
        return self._field.low, self._field.high

    @property
    def near(self) -> float:
        """Metres along the axis within which nothing is drawn."""
        widest = max(float(np.abs(bound).max()) for bound in self.bounds)
        return NEAR if widest < _BESIDE_FROM else _NEAR_BESIDE

    def straight_angle(self, low: tuple[int, int], high: tuple[int, int]) -> float:
        """The angle, radians, of edges that surely are not bent visibly between the pixels ``low`` and
        ``high``: their length over their distance.
        """
        bends = self._field.bends
        cells = np.maximum(np.array(self.camera.size) - 1, 1) / (_GRID - 1)
        x0, y0 = np.clip(np.floor(low / cells), 0, _GRID - 1).astype(int)
        x1, y1 = np.clip(np.ceil(high / cells), 0, _GRID - 1).astype(int) + 1
        bend = float(bends[y0:y1, x0:x1].max())
        return float(np.sqrt(8 * VISIBLE / max(bend, 1e-9)))

    def _sides_beyond(self, points: Array) -> NDArray[np.uint8]:
        """Beyond which sides of the image points (V, 3), optical frame, surely are: a bit each."""
        x, y, z = points.T
        (left, top), (right, bottom) = self.bounds
        beyond = [z < self.near, x < left * z, x > right * z, y < top * z, y > bottom * z]
        return np.packbits(beyond, axis=0)[0]

    def image_of(self, low: Array, high: Array) -> tuple[Array, Array]:
        """Lowest and highest pixels, each (2,), of what lies between ``low`` and ``high`` of the normalised
        image plane; infinite and -infinite where nothing of it is seen.
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
        """Which edges (E, 3), optical frame, are to be halved so that none is off by more than a tolerance,
        in pixels.
        """
        points = starts, ends, (starts + ends) / 2
        return self._bent(points, [self.camera.project_optical(p)[0] for p in points], tolerance)[0]

    def _bent(
        self, points: Sequence[Array], pixels: Sequence[Array], tolerance: float
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which edges are to be halved, and whether their halves need not be looked at.

        ``points``: their starts, ends and middles (E, 3), optical frame; ``pixels``: the same (E, 2).
        """
        (start, end, middle), (a, b, m) = points, pixels
        seen_a, seen_b = np.isfinite(a[:, 0]), np.isfinite(b[:, 0])
        with np.errstate(invalid="ignore", divide="ignore"):
            za, zb = start[:, 2:], end[:, 2:]
            off = _length(m - (a * za + b * zb) / (za + zb))
            span = _length(a - b)
            before, behind = np.maximum(a, b) < -_BESIDE, np.minimum(a, b) > np.add(self.camera.size, _BESIDE)
            allowed = tolerance * np.maximum(1.0, _length(middle[:, :2]) / (middle[:, 2] * _FAR_OFF))
            bent = ((off > allowed) & ~(before | behind).any(axis=1)) | (span > _LONGEST)
            enough = (off < _SURELY * allowed) & (span < _LONGEST)
        if not (seen_a & seen_b).all():
            length, distance = _length(end - start), _length(start + end) / 2
            rim, beyond = length > _RIM * distance, length > _BEYOND * distance
            bent = np.where(seen_a & seen_b, bent, np.where(seen_a | seen_b, rim, beyond))
        return bent, enough

    def tessellate(
        self, attributes: Array, triangles: Indices, tolerance: float = TOLERANCE
    ) -> TessellatedMesh:
        """Cut triangles (N, 3) of ``attributes`` (V, 3 + k), which begin with a position in the world, until
        no edge is off by more than a tolerance, in pixels.

        What is outside the image is left out.
        """
        corners, parents = triangles.astype(np.intp), np.arange(len(triangles), dtype=np.intp)
        # each round has its own edges: their ends (E, 2), and which of them the sides ab, bc, ca of each
        # triangle are; -1 for sides that are straight
        sides = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        keys, inverse = np.unique(sides[:, 0] * len(attributes) + sides[:, 1], return_inverse=True)
        ends = np.stack([keys // len(attributes), keys % len(attributes)], axis=1)
        edges = inverse.reshape(-1, 3)
        points = self.camera.to_optical(attributes[:, :3])
        pixels, beyond = self.camera.project_optical(points)[0], self._sides_beyond(points)
        done, count = [(corners[:0], parents[:0])], 0
        for _ in range(_ROUNDS):
            a, b, c = beyond[corners].T
            kept = (a & b & c) == 0
            straight = kept & (edges < 0).all(axis=1)
            done.append((corners[straight], parents[straight]))
            kept &= ~straight
            corners, edges, parents = corners[kept], edges[kept], parents[kept]
            count += len(corners)
            if not len(corners) or count > _MAX_TRIANGLES:
                break
            used = np.zeros(len(ends) + 1, bool)
            used[edges] = True
            looked_at = np.flatnonzero(used[:-1])
            first, second = ends[looked_at].T
            middles = (points[first] + points[second]) / 2
            fallen = self.camera.project_optical(middles)[0]
            halved, enough = self._bent(
                (points[first], points[second], middles), (pixels[first], pixels[second], fallen), tolerance
            )
            cut, further = looked_at[halved], ~enough[halved]
            new = 2 * int(np.count_nonzero(further))
            # by edge; the last one stands for -1
            middle, half = np.full((2, len(ends) + 1), -1)
            middle[cut] = len(points) + np.arange(len(cut))
            half[cut[further]] = np.arange(0, new, 2)
            halves = _halves(corners, ends[edges], half[edges])
            pieces = _divided(corners, middle[edges], halves, new)
            attributes = np.concatenate([attributes, attributes[ends[cut]].mean(axis=1)])
            points = np.concatenate([points, middles[halved]])
            pixels = np.concatenate([pixels, fallen[halved]])
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
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Edges (E, 3), world, cut into pieces (P, 3) that are straight in the image."""
        done_starts, done_ends = [starts[:0]], [ends[:0]]
        for _ in range(_ROUNDS):
            halved = self.bent(
                self.camera.to_optical(starts), self.camera.to_optical(ends), tolerance=TOLERANCE
            )
            done_starts.append(starts[~halved])
            done_ends.append(ends[~halved])
            starts, ends = starts[halved], ends[halved]
            if not len(starts) or len(starts) > _MAX_TRIANGLES:
                break
            middles = (starts + ends) / 2
            starts, ends = np.concatenate([starts, middles]), np.concatenate([middles, ends])
        return np.concatenate([*done_starts, starts]), np.concatenate([*done_ends, ends])


def near_plane(camera: Camera) -> float:
    """Metres along its axis within which nothing is drawn for a camera."""
    return LensView(camera).near if camera.distorted else NEAR


@dataclass(frozen=True)
class _Field:
    """What a lens shows: bounds in the normalised image plane, and whether they leave the image partly dark.

    ``bends``: on a grid over the image, by how many pixels the image of a line may be bent, per square of the
    angle that the line spans (radians).
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
    if dark:  # the rim of what it sees lies inside the image
        low, high = np.full(2, -lens.valid_radius), np.full(2, lens.valid_radius)
    n = camera.rays(np.stack(np.meshgrid(x, y), axis=-1))[..., :2]
    spread = 1 + np.einsum("...i,...i->...", n, n)
    step = 1e-4 * spread[..., None]
    second = np.zeros(n.shape[:-1])
    for axis in np.eye(2):
        change = lens.jacobian(n + step * axis) - lens.jacobian(n - step * axis)
        second += ((change / (2 * step[..., None])) ** 2).sum(axis=(-1, -2))
    bends = np.nan_to_num(np.sqrt(second) * spread**2) * float(np.abs(camera.K[:2, :2]).max())
    return _Field(low, high, dark, bends)


def _border(x: Array, y: Array) -> Array:
    """Points (P, 2) on the sides of the rectangle that x and y (rising) span."""
    across, down = np.ones_like(x), np.ones_like(y)
    sides = [(x, y[0] * across), (x, y[-1] * across), (x[0] * down, y), (x[-1] * down, y)]
    return np.concatenate([np.stack(side, axis=1) for side in sides])


def _length(vectors: Array) -> Array:
    """(N,) of (N, k)."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))


def _halves(corners: Indices, ends: Indices, half: Indices) -> Indices:
    """Edges (N, 3, 2) that the halves of the sides of triangles (N, 3) become, that at a side's start first.

    ``ends`` (N, 3, 2) of the edges that the sides were; ``half`` (N, 3): the edge that the half at the first
    of these ends becomes, the other half becomes the next one; or -1.
    """
    turned = (ends[..., 0] != corners).astype(np.intp)
    both = np.stack([half + turned, half + 1 - turned], axis=2)
    return np.where(half[..., None] < 0, -1, both)


class _Pieces(NamedTuple):
    """``corners`` (P, 3) and ``edges`` (P, 3) of pieces, ``parts`` (P,): which triangle each is a piece of.

    ``within``: ends (E, 2) of the edges between the pieces of a triangle.
    """

    corners: Indices
    edges: Indices
    parts: Indices
    within: Indices


#: Pieces of a triangle, by how many of its sides are halved: corners, edges, and ends of the edges within.
#: Corners: 0 1 2 (a b c), 3 4 5 (middles of ab bc ca). Edges: 0 straight, 1 to 6 halves of ab bc ca, 7 8 9
#: those within.
_CUTS: dict[int, tuple[list[tuple[int, int, int]], list[tuple[int, int, int]], list[tuple[int, int]]]] = {
    0: ([(0, 1, 2)], [(0, 0, 0)], []),
    # turned so that ab is halved
    1: ([(0, 3, 2), (3, 1, 2)], [(1, 7, 0), (2, 0, 7)], [(3, 2)]),
    # turned so that ca is the side that stays
    2: ([(3, 1, 4), (0, 3, 4), (0, 4, 2)], [(2, 3, 7), (1, 7, 8), (8, 4, 0)], [(3, 4), (0, 4)]),
    3: (
        [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)],
        [(1, 7, 6), (2, 3, 8), (9, 4, 5), (8, 9, 7)],
        [(3, 5), (3, 4), (4, 5)],
    ),
}


def _divided(corners: Indices, middles: Indices, halves: Indices, first: int) -> _Pieces:
    """Triangles (N, 3) whose sides ab, bc, ca have a vertex ``middles`` (N, 3) or -1, in pieces.

    ``halves`` (N, 3, 2): edges that the halves of their sides become. ``first``: number of the first edge
    between pieces.
    """
    count = (middles >= 0).sum(axis=1)
    turns = np.zeros(len(corners), np.intp)
    turns[count == 1] = np.argmax(middles[count == 1] >= 0, axis=1)
    turns[count == 2] = np.argmax(middles[count == 2] < 0, axis=1) + 1
    found = []
    for number, (pieces, edges, within) in _CUTS.items():
        rows = np.flatnonzero(count == number)
        order = (np.arange(3) + turns[rows, None]) % 3
        at = rows[:, None]
        six = np.concatenate([corners[at, order], middles[at, order]], axis=1)
        new = first + np.arange(len(rows) * len(within), dtype=np.intp).reshape(len(rows), len(within))
        first += new.size
        ten = np.concatenate([np.full_like(at, -1), halves[at, order].reshape(-1, 6), new], axis=1)
        found.append(
            _Pieces(
                six[:, pieces].reshape(-1, 3),
                ten[:, edges].reshape(-1, 3),
                np.repeat(rows, len(pieces)),
                six[:, np.reshape(within, (-1, 2)).astype(np.intp)].reshape(-1, 2),
            )
        )
    return _Pieces(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
