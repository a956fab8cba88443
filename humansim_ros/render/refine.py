"""Triangles cut so small that a lens may bend their edges: between vertices all lines drawn are straight.

Edges are halved until their middles fall within a fraction of a pixel of where they would be drawn. That an
edge is halved depends on its two ends alone, so that triangles which share one stay together.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.camera.lens import Lens
from humansim_ros.rotations import Array

#: Pixels that an edge may be away from where it should be.
TOLERANCE = 0.03
#: Edges longer than so many pixels are halved anyway: their middle alone says too little.
_LONGEST = 48.0
#: Beside the image by so many pixels it does not matter.
_BESIDE = 100.0
#: Edges at the rim of what the lens sees are cut down to this share of their distance.
_RIM, _BEYOND = 0.01, 0.1
#: Points along each side of the image at which the lens is looked at.
_GRID = 65
_ROUNDS, _MOST_TRIANGLES = 14, 4_000_000
#: Metres from the camera within which nothing is drawn.
NEAR = 0.05

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Refined:
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

    def longest_straight(self, distance: float, low: Array, high: Array) -> float:
        """Length of an edge, in metres, that surely is not bent visibly at a distance or farther, between the
        pixels ``low`` and ``high``, each (2,).
        """
        bends = self._field.bends
        cells = (np.array(self.camera.size) - 1) / (_GRID - 1)
        x0, y0 = np.clip(np.floor(low / cells), 0, _GRID - 1).astype(int)
        x1, y1 = np.clip(np.ceil(high / cells), 0, _GRID - 1).astype(int) + 1
        bend = float(bends[y0:y1, x0:x1].max())
        return distance * float(np.sqrt(8 * TOLERANCE / max(bend, 1e-9)))

    def outside(self, corners: Array) -> NDArray[np.bool_]:
        """Which triangles (N, 3, 3), optical frame, surely are not in the image: beyond one of its sides."""
        x, y, z = np.moveaxis(corners, -1, 0)
        (left, top), (right, bottom) = self.bounds
        beyond = [z < NEAR, x < left * z, x > right * z, y < top * z, y > bottom * z]
        return np.asarray(np.any([side.all(axis=1) for side in beyond], axis=0))

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

    def bent(self, starts: Array, ends: Array) -> NDArray[np.bool_]:
        """Which edges (E, 3), optical frame, are to be halved."""
        middles = (starts + ends) / 2
        (a, za), (b, zb), (m, _) = (self.camera.project_optical(p) for p in (starts, ends, middles))
        length = np.linalg.norm(ends - starts, axis=1)
        distance = np.linalg.norm(middles, axis=1)
        seen_a, seen_b = np.isfinite(a[:, 0]), np.isfinite(b[:, 0])
        with np.errstate(invalid="ignore", divide="ignore"):
            drawn = (a * za[:, None] + b * zb[:, None]) / (za + zb)[:, None]
            off = np.linalg.norm(m - drawn, axis=1)
            span = np.linalg.norm(a - b, axis=1)
            size = np.array(self.camera.size)
            beside = ((np.maximum(a, b) < -_BESIDE) | (np.minimum(a, b) > size + _BESIDE)).any(axis=1)
            bent = ((off > TOLERANCE) | (span > _LONGEST)) & ~(beside & (span < _BESIDE))
        rim = length > _RIM * distance
        beyond = length > _BEYOND * distance
        return np.asarray(np.where(seen_a & seen_b, bent, np.where(seen_a | seen_b, rim, beyond)))

    def refine(self, attributes: Array, triangles: Indices) -> Refined:
        """Cut triangles (N, 3) of ``attributes`` (V, 3 + k), which begin with a position in the world.

        What is outside the image is left out.
        """
        triangles = triangles.astype(np.intp)
        parents: Indices = np.arange(len(triangles), dtype=np.intp)
        optical = self.camera.to_optical(attributes[:, :3])
        for _ in range(_ROUNDS):
            kept = ~self.outside(optical[triangles])
            triangles, parents = triangles[kept], parents[kept]
            sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
            keys, inverse = np.unique(sides[:, 0] * len(attributes) + sides[:, 1], return_inverse=True)
            edges = np.stack([keys // len(attributes), keys % len(attributes)], axis=1)
            halved = self.bent(*(optical[ends] for ends in edges.T))
            if not halved.any() or len(triangles) > _MOST_TRIANGLES:
                break
            middle = np.where(halved, len(attributes) + np.cumsum(halved) - 1, -1)
            ends = edges[halved]
            attributes, optical = (
                np.concatenate([values, values[ends].mean(axis=1)]) for values in (attributes, optical)
            )
            triangles, parts = _divided(triangles, middle[inverse].reshape(-1, 3))
            parents = parents[parts]
        return Refined(attributes, triangles, parents)

    def divide_edges(
        self, starts: NDArray[np.floating], ends: NDArray[np.floating]
    ) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Edges (E, 3), world, cut into pieces (P, 3) that are straight in the image."""
        done_starts, done_ends = [starts[:0]], [ends[:0]]
        for _ in range(_ROUNDS):
            halved = self.bent(self.camera.to_optical(starts), self.camera.to_optical(ends))
            done_starts.append(starts[~halved])
            done_ends.append(ends[~halved])
            starts, ends = starts[halved], ends[halved]
            if not len(starts) or len(starts) > _MOST_TRIANGLES:
                break
            middles = (starts + ends) / 2
            starts, ends = np.concatenate([starts, middles]), np.concatenate([middles, ends])
        return np.concatenate([*done_starts, starts]), np.concatenate([*done_ends, ends])


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
    x, y = (np.linspace(-0.5, n - 0.5, _GRID) for n in size)
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


def _divided(triangles: Indices, middles: Indices) -> tuple[Indices, Indices]:
    """Triangles (N, 3) whose edges ab, bc, ca have a vertex ``middles`` (N, 3) or -1, in pieces; and which
    triangle each piece is of.
    """
    count = (middles >= 0).sum(axis=1)
    pieces, parts = [triangles[count == 0]], [np.flatnonzero(count == 0)]

    def cut(rows: Indices, turn: NDArray[np.intp] | int, *corners: tuple[int, int, int]) -> None:
        """Pieces of corners 0 1 2 (a b c) and 3 4 5 (middles of ab bc ca), turned to begin at a corner."""
        order = (np.arange(3) + np.reshape(turn, (-1, 1))) % 3
        order = np.broadcast_to(order, (len(rows), 3))
        six = np.concatenate(
            [np.take_along_axis(v[rows], order, axis=1) for v in (triangles, middles)], axis=1
        )
        for piece in corners:
            pieces.append(six[:, list(piece)])
            parts.append(rows)

    one = np.flatnonzero(count == 1)
    cut(one, np.argmax(middles[one] >= 0, axis=1), (0, 3, 2), (3, 1, 2))
    two = np.flatnonzero(count == 2)
    # turned so that ca is the edge that stays
    cut(two, (np.argmax(middles[two] < 0, axis=1) + 1) % 3, (3, 1, 4), (0, 3, 4), (0, 4, 2))
    three = np.flatnonzero(count == 3)
    cut(three, 0, (0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5))
    return np.concatenate(pieces), np.concatenate(parts)
