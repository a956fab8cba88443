"""How people of a crowd find their way and avoid each other.

Optimal reciprocal collision avoidance (ORCA) [van den Berg 2011]: some velocities lead to no collision within
a time horizon, if all people choose so. Among these, each person takes the velocity nearest to the preferred
one. A person who walks does not see people behind, so the people behind must make way alone. Each neighbour
and each obstacle forbids a half-plane of velocities. A half-plane is a unit normal n and an offset c: a
velocity v is allowed if n . v >= c.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.ndimage
import scipy.sparse
from numpy.typing import NDArray

from humansim_ros.types import Array, Indices

#: Most neighbours that a person avoids, and the distance (metres) at which this begins.
_NEIGHBOURS, _SIGHT = 8, 6.0
#: Somebody is behind a walking person if the cosine of the angle to the direction of the walk is below the
#: first value. A person who is slower than the second value (m/s) stands.
_BEHIND, _STANDS = -0.3, 0.2
#: Tolerance of a half-plane, m/s.
_EXACT = 1e-9
#: A person who cannot obey all half-planes moves out of the most violated one in this number of rounds. The
#: last value is the share of each step.
_ROUNDS, _RELAXED = 24, 0.7


@dataclass(frozen=True)
class Walkers:
    """People on the floor at one time.

    Attributes:
        positions: (N, 2) metres.
        velocities: (N, 2) m/s.
        radii: (N,) metres.
        speeds: (N,) largest speeds, m/s.
        waiting: (N,) whether a person keeps its place, so that the others must make way alone.
    """

    positions: Array
    velocities: Array
    radii: Array
    speeds: Array
    waiting: NDArray[np.bool_]

    def avoiding(
        self, preferred: Array, obstacles: Array, margin: float, horizon: float, step: float
    ) -> Array:
        """Find velocities (N, 2) that avoid the others and the obstacles.

        Args:
            preferred: (N, 2) velocities that the people would have if alone, m/s.
            obstacles: (N, M, 2) points that each person keeps away from, metres.
            margin: Distance that people keep from such a point in addition to their radius, metres.
            horizon: Seconds within which people must not collide. For obstacles, half of it.
            step: Seconds until the next velocities.
        """
        fixed = _obstacle_planes(self, obstacles, margin, horizon / 2)
        others = _neighbour_planes(self, horizon, step)
        normals, offsets = (np.concatenate(pair, axis=1) for pair in zip(fixed, others, strict=True))
        velocities = nearest_allowed(preferred, normals, offsets, self.speeds, obstacles.shape[1])
        return np.where(self.waiting[:, None], 0.0, velocities)


def _obstacle_planes(walkers: Walkers, points: Array, margin: float, horizon: float) -> tuple[Array, Array]:
    """Half-planes in which nobody reaches a point within the horizon: normals (N, M, 2) and offsets (N,
    M)."""
    away = walkers.positions[:, None] - points
    distance = np.maximum(np.linalg.norm(away, axis=-1), 1e-9)
    room = distance - walkers.radii[:, None] - margin
    return away / distance[..., None], -np.where(np.isfinite(room), room, np.inf) / horizon


def _neighbour_planes(walkers: Walkers, horizon: float, step: float) -> tuple[Array, Array]:
    """Half-planes of the nearest other people [van den Berg 2011, section 4]: normals (N, K, 2) and offsets
    (N, K)."""
    near = _nearest(walkers.positions)
    own = np.arange(len(near))[:, None]
    position = walkers.positions[near] - walkers.positions[own]
    velocity = walkers.velocities[own] - walkers.velocities[near]
    radius = walkers.radii[near] + walkers.radii[own]
    squared = (position**2).sum(-1)
    # the part of the cone that is cut off by the disc of a collision at the horizon. If people touch already,
    # the horizon is one step
    time = np.where(squared > radius**2, horizon, step)
    w = velocity - position / time[..., None]
    length = np.maximum(np.linalg.norm(w, axis=-1), 1e-9)
    along = (w * position).sum(-1)
    normal = w / length[..., None]
    change = (radius / time - length)[..., None] * normal
    leg = np.sqrt(np.maximum(squared - radius**2, 0.0))
    side = np.where(_det(position, w) > 0, 1.0, -1.0)
    # the legs of the cone: the direction turns away from the other person, to the side where w is
    x, y = position[..., 0], position[..., 1]
    direction = np.stack([x * leg - side * y * radius, side * x * radius + y * leg], axis=-1)
    direction /= np.maximum(squared, 1e-12)[..., None]
    by_leg = (squared > radius**2) & ~((along < 0) & (along**2 > (radius * length) ** 2))
    on_leg = (velocity * direction).sum(-1)[..., None] * direction - velocity
    outwards = side[..., None] * np.stack([-direction[..., 1], direction[..., 0]], axis=-1)
    normal = np.where(by_leg[..., None], outwards, normal)
    change = np.where(by_leg[..., None], on_leg, change)
    seen, sees = (
        _in_view(place, walkers.velocities[who])
        for place, who in ((position, np.broadcast_to(own, near.shape)), (-position, near))
    )
    # a person who comes from behind, or who meets somebody who keeps the place, makes way alone
    share = np.where((seen & ~sees) | walkers.waiting[near], 1.0, 0.5)[..., None]
    offset = (normal * (walkers.velocities[own] + share * change)).sum(-1)
    far = (squared > _SIGHT**2) | (near == own) | (sees & ~seen & ~walkers.waiting[near])
    return normal, np.where(far, -np.inf, offset)


def _in_view(positions: Array, velocities: Array) -> NDArray[np.bool_]:
    """Whether people with velocities (..., 2) see relative positions (..., 2). A person who stands sees
    everybody."""
    ahead = (positions * velocities).sum(-1)
    speed = np.linalg.norm(velocities, axis=-1)
    return np.asarray((ahead > _BEHIND * speed * np.linalg.norm(positions, axis=-1)) | (speed < _STANDS))


def _nearest(positions: Array) -> Indices:
    """Numbers (N, K) of the nearest others. If there are too few, the number of the person itself."""
    count = len(positions)
    apart = ((positions[:, None] - positions) ** 2).sum(-1)
    np.fill_diagonal(apart, np.inf)
    keep = min(_NEIGHBOURS, count - 1)
    if keep < 1:
        return np.zeros((count, 1), np.intp)
    return np.argpartition(apart, keep - 1, axis=1)[:, :keep]


def nearest_allowed(preferred: Array, normals: Array, offsets: Array, speeds: Array, fixed: int) -> Array:
    """Velocities (N, 2) in all half-planes and in a disc that are nearest to the preferred ones.

    Solves the linear program of [van den Berg 2011, section 5.3] for all people together. If no velocity is
    in all half-planes, the largest violation is made small. For the ``fixed`` half-planes, it is made smaller
    than for those of other people.

    Args:
        preferred: (N, 2) m/s.
        normals: (N, M, 2) unit normals.
        offsets: (N, M) m/s. An offset of -inf means that there is no half-plane.
        speeds: (N,) radii of the discs, m/s.
        fixed: This number of half-planes, from the first on, belong to obstacles.
    """
    speed = np.linalg.norm(preferred, axis=-1, keepdims=True)
    goal = preferred * np.minimum(1.0, speeds[:, None] / np.maximum(speed, 1e-9))
    velocity, failed = goal.copy(), np.zeros(len(goal), bool)
    for number in range(normals.shape[1]):
        n, c = normals[:, number], offsets[:, number]
        left = np.flatnonzero(((n * velocity).sum(-1) < c - _EXACT) & ~failed)
        if len(left):
            upto = slice(number + 1)
            found, ok = _on_line(goal[left], normals[left, upto], offsets[left, upto], speeds[left])
            velocity[left[ok]] = found[ok]
            failed[left[~ok]] = True
    if failed.any():
        violating = velocity[failed], normals[failed], offsets[failed], speeds[failed]
        velocity[failed] = _least_violation(*violating, fixed)
    return velocity


def _on_line(goal: Array, normals: Array, offsets: Array, speeds: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Best velocities on the edge of the last half-plane and within the others, and whether there are any."""
    n, c = normals[:, -1], offsets[:, -1]
    along = np.stack([-n[:, 1], n[:, 0]], axis=-1)
    half = speeds**2 - c**2
    reach = np.sqrt(np.maximum(half, 0.0))
    slope = (normals[:, :-1] * along[:, None]).sum(-1)
    need = offsets[:, :-1] - (normals[:, :-1] * (c[:, None] * n)[:, None]).sum(-1)
    parallel = np.abs(slope) < 1e-9
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = need / slope
    low = np.where(~parallel & (slope > 0), bound, -np.inf).max(axis=1, initial=-np.inf)
    high = np.where(~parallel & (slope < 0), bound, np.inf).min(axis=1, initial=np.inf)
    low, high = np.maximum(low, -reach), np.minimum(high, reach)
    ok = (half >= 0) & (low <= high) & ~(parallel & (need > _EXACT)).any(axis=1)
    place = np.clip((goal * along).sum(-1), low, np.maximum(low, high))
    return c[:, None] * n + place[:, None] * along, ok


def _least_violation(velocity: Array, normals: Array, offsets: Array, speeds: Array, fixed: int) -> Array:
    """Velocities (N, 2) that violate no half-plane much. Half-planes of obstacles are violated least."""
    rows = np.arange(len(velocity))
    for number in range(_ROUNDS):
        used = slice(0, fixed) if number % 3 == 2 and fixed else slice(None)
        lacking = offsets[:, used] - (normals[:, used] * velocity[:, None]).sum(-1)
        worst = lacking.argmax(axis=1)
        step = _RELAXED * np.maximum(lacking[rows, worst], 0.0)
        velocity = velocity + step[:, None] * normals[:, used][rows, worst]
        speed = np.linalg.norm(velocity, axis=-1)
        velocity *= np.minimum(1.0, speeds / np.maximum(speed, 1e-9))[:, None]
    return velocity


def _det(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


#: Size of a cell, metres; most cells along a side: a longer side has larger cells.
_CELL, _MOST_CELLS = 0.1, 800
#: Obstacles are searched around points at this distance from a person, metres, in this number of directions.
_LOOK, _DIRECTIONS = 0.5, 6
#: Metres between the points of a line that must be free.
_ALONG = 0.1
#: Steps from a cell to its neighbours. Each step also stands for the opposite step.
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
        """Half of a cell, metres: a covered thing reaches this far from the middle of its cell."""
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
        """Corners (2,) of a short way from ``start`` to ``end``, with ``end``; None if there is no way."""
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
