"""Optimal reciprocal collision avoidance (ORCA) for many people at once [van den Berg 2011].

Some velocities lead to no collision within a time horizon, if all people choose so. Among these, each person
takes the velocity nearest to the preferred one. A person who walks does not see people behind, so the people
behind must make way alone. Each neighbour and each obstacle forbids a half-plane of velocities. A half-plane
is a unit normal n and an offset c: a velocity v is allowed if n . v >= c.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
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
            found, ok = _on_line(
                goal[left], normals[left, : number + 1], offsets[left, : number + 1], speeds[left]
            )
            velocity[left[ok]] = found[ok]
            failed[left[~ok]] = True
    if failed.any():
        velocity[failed] = _least_violation(
            velocity[failed], normals[failed], offsets[failed], speeds[failed], fixed
        )
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
