"""Floor of a crowd on a grid: where people fit, what they keep away from, and ways around it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.ndimage
import scipy.sparse
from numpy.typing import NDArray

from humansim_ros.types import Array, Indices

#: Size of a cell, metres; most cells along a side: a longer side has larger cells.
_CELL, _MOST_CELLS = 0.1, 800
#: Distance, metres, from a person at which obstacles are looked for, and the number of directions.
_LOOK, _DIRECTIONS = 0.5, 6
#: Metres between the points of a line that must be free.
_ALONG = 0.1
#: Steps from a cell to its neighbours; each stands for its opposite, too.
_STEPS = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))


@dataclass(frozen=True)
class WalkGrid:
    """Cells of a floor that are covered or not.

    Attributes:
        low: (2,) corner of the first cell, metres in ``map``.
        cell: Side of a cell, metres.
        covered: (X, Y) whether a cell is covered by a wall or a thing. The border is always covered.
        radius: Radius of the people, metres.
    """

    low: Array
    cell: float
    covered: NDArray[np.bool_]
    radius: float

    @classmethod
    def of(cls, corners: Array, things: Array, radius: float) -> WalkGrid:
        """Floor between two corners (2, 2) with walls around it, and points (M, 2) that are covered."""
        low, high = corners
        cell = max(_CELL, float((high - low).max()) / _MOST_CELLS)
        shape = np.ceil((high - low) / cell - 1e-6).astype(int) + 2
        covered = np.ones(shape, bool)
        covered[1:-1, 1:-1] = False
        # the cells around the floor are walls: their middles are half a cell behind the corner
        plan = cls(low - cell, cell, covered, radius)
        cells = np.floor((things - plan.low) / cell).astype(int)
        cells = cells[((cells >= 0) & (cells < shape)).all(axis=1)]
        covered[tuple(cells.T)] = True
        return plan

    @cached_property
    def _distances(self) -> tuple[Array, NDArray[np.int32]]:
        found: Any = scipy.ndimage.distance_transform_edt(~self.covered, return_indices=True)
        return self.cell * found[0], found[1]

    @property
    def high(self) -> Array:
        """(2,) corner after the last cell, metres in ``map``."""
        return np.asarray(self.low + self.cell * np.array(self.covered.shape))

    @property
    def margin(self) -> float:
        """Half of a cell, metres: what is covered reaches that far from the middle of its cell."""
        return self.cell / 2

    def _cells(self, points: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        cells = np.floor((points - self.low) / self.cell).astype(np.int64)
        x, y = np.moveaxis(cells, -1, 0)
        return x.clip(0, self.covered.shape[0] - 1), y.clip(0, self.covered.shape[1] - 1)

    def _middles(self, cells: NDArray[np.integer]) -> Array:
        return np.asarray(self.low + (cells + 0.5) * self.cell)

    def free(self, points: Array) -> NDArray[np.bool_]:
        """Whether a person fits at points (..., 2)."""
        return np.asarray(self._distances[0][self._cells(points)] >= self.radius + self.margin)

    def places(self, corners: Array | None = None) -> Array:
        """Middles (M, 2) of the cells where a person fits, within two corners (2, 2)."""
        found = self._middles(self._free_cells)
        if corners is None:
            return found
        low, high = corners.min(axis=0), corners.max(axis=0)
        return found[((found >= low) & (found <= high)).all(axis=1)]

    def obstacles(self, points: Array) -> Array:
        """Nearest covered points (N, M, 2), seen from points (N, 2) and from around them."""
        angles = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
        around = _LOOK * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        look = points[:, None] + np.concatenate([np.zeros((1, 2)), around])
        x, y = self._cells(look)
        return self._middles(np.moveaxis(self._distances[1][:, x, y], 0, -1))

    def sees(self, starts: Array, ends: Array) -> NDArray[np.bool_]:
        """Whether a person can walk straight from (N, 2) to (N, 2)."""
        longest = float(np.linalg.norm(ends - starts, axis=-1).max(initial=0.0))
        share = np.linspace(0.0, 1.0, 2 + int(longest / _ALONG))[:, None, None]
        return np.asarray(self.free(starts + share * (ends - starts)).all(axis=0))

    @cached_property
    def _free_cells(self) -> Indices:
        return np.argwhere(self._distances[0] >= self.radius + self.margin)

    @cached_property
    def _graph(self) -> tuple[NDArray[np.int64], Any]:
        """Numbers (X, Y) of the free cells, -1 for others; and the graph of their distances."""
        free = self._distances[0] >= self.radius + self.margin
        number = np.where(free, np.cumsum(free).reshape(free.shape) - 1, -1)
        rows, columns, lengths = [], [], []
        width, depth = free.shape
        for dx, dy in _STEPS:
            here = number[: width - dx, max(0, -dy) : depth - max(0, dy)]
            there = number[dx:, max(0, dy) : depth - max(0, -dy)]
            both = (here >= 0) & (there >= 0)
            rows.append(here[both])
            columns.append(there[both])
            lengths.append(np.full(int(both.sum()), self.cell * np.hypot(dx, dy)))
        count = int(free.sum())
        edges = (np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns)))
        return number, scipy.sparse.csr_matrix(edges, shape=(count, count))

    def way(self, start: Array, end: Array) -> list[Array] | None:
        """Corners (2,) of a short way from ``start`` to ``end``, the last one; None if there is no way."""
        if self.sees(start[None], end[None])[0]:
            return [end]
        number, graph = self._graph
        first, last = (self._nearest_free(number, point) for point in (start, end))
        if first is None or last is None:
            return None
        before = scipy.sparse.csgraph.dijkstra(graph, False, last, return_predecessors=True)[1]
        chain: list[int] = [first]
        while chain[-1] != last:
            if before[chain[-1]] < 0:
                return None
            chain.append(int(before[chain[-1]]))
        line = self._middles(self._free_cells[chain])
        return self._straightened(np.concatenate([start[None], line, end[None]]))

    def _straightened(self, line: Array) -> list[Array]:
        """Corners of a line (M, 2) after its first point; each is the farthest that the one before sees."""
        corners, at = [], 0
        while at < len(line) - 1:
            ahead = line[at + 1 :]
            seen = np.flatnonzero(self.sees(np.broadcast_to(line[at], ahead.shape), ahead))
            at += 1 + (int(seen[-1]) if len(seen) else 0)
            corners.append(line[at])
        return corners

    def _nearest_free(self, number: NDArray[np.int64], point: Array) -> int | None:
        """Number of the nearest free cell."""
        if (found := int(number[tuple(int(one) for one in self._cells(point))])) >= 0:
            return found
        if not len(self._free_cells):
            return None
        return int(((self._middles(self._free_cells) - point) ** 2).sum(axis=1).argmin())
