"""Places of random humans: their whole paths stay in the room, and away from furniture and other humans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from humansim_ros.scene.actor import Actor
from humansim_ros.types import Array

#: Least distances in metres of joints, which are inside the body, from walls, things and joints of others.
_FROM_WALLS, _FROM_THINGS, _FROM_HUMANS = 0.2, 0.2, 0.2
#: Seconds between two poses of a path, and most poses of a path.
_STEP, _MOST_POSES = 0.05, 3000
#: Seconds of the scene in which the paths of the scene's own humans are known.
_DURATION = 60.0
#: Metres between the points that stand for a path or for a thing.
_CELL = 0.05
#: Step between the points of a path that are compared first; most bad places show there.
_COARSE = 8
#: Paths after which the paths so far are searched as one.
_GROUP = 16


@dataclass(frozen=True)
class Path:
    """Joints of a human in all poses of its motion, seen from above.

    Attributes:
        points: (F, 2) metres, where one joint or more comes.
    """

    points: Array

    @classmethod
    def of_cycle(cls, actor: Actor) -> Path:
        """Path of one cycle of a motion; the path of a motion that repeats does not grow after it."""
        motion = actor.motion
        length = motion.duration if np.isfinite(motion.duration) else 0.0
        count = min(_MOST_POSES, 2 + int(length / _STEP))
        # the end of a cycle is the start of the next
        return cls._of(actor, np.linspace(0.0, length * (1 - 1e-6), count) - actor.offset)

    @classmethod
    def of_scene(cls, actor: Actor) -> Path:
        """Path in the first minute of a scene, as a motion may travel for ever."""
        return cls._of(actor, np.arange(0.0, _DURATION, 2 * _STEP))

    @classmethod
    def _of(cls, actor: Actor, times: Array) -> Path:
        joints = actor.joint_paths(times)[..., :2].reshape(-1, 2)
        return cls(_CELL * np.unique(np.round(joints / _CELL), axis=0))

    def turned(self, yaw: float) -> Path:
        """The path of a human that starts at the origin with another heading, radians to the left."""
        c, s = np.cos(yaw), np.sin(yaw)
        return Path(self.points @ np.array([[c, s], [-s, c]]))

    def mirrored(self) -> Path:
        """The path with left and right exchanged, along +x."""
        return Path(self.points * (1, -1))

    def moved(self, shift: Array) -> Path:
        """The path moved by (2,) metres."""
        return Path(self.points + shift)

    @property
    def box(self) -> tuple[Array, Array]:
        """Low and high corner (2,)."""
        return self.points.min(axis=0), self.points.max(axis=0)

    @property
    def middle(self) -> Array:
        """Middle (2,) of the ground that the path covers."""
        low, high = self.box
        return np.asarray((low + high) / 2)

    @property
    def size(self) -> float:
        """Length of the diagonal of its box, metres."""
        low, high = self.box
        return float(np.linalg.norm(high - low))


class Floor:
    """Floor of a scene, with everything that stands on it.

    Args:
        room: Size (x, y) of the room around the origin, metres; None for no walls.
        things: (M, 2) points that are covered by furniture and objects, about 5 cm apart.
        spacing: Least distance of the middles of two paths, metres.
    """

    def __init__(self, room: Sequence[float] | None, things: Array, spacing: float) -> None:
        self._half = None if room is None else np.array(room[:2]) / 2 - _FROM_WALLS
        self._things = scipy.spatial.cKDTree(things) if len(things) else None
        self._spacing = spacing
        self._middles = np.zeros((0, 2))
        self._old: scipy.spatial.cKDTree | None = None
        self._paths: list[Array] = []
        self._recent: list[Array] = []

    @property
    def count(self) -> int:
        """Number of paths on the floor."""
        return len(self._middles)

    def add(self, path: Path) -> None:
        """Add the path of a human."""
        self._middles = np.vstack([self._middles, path.middle])
        self._recent.append(path.points)
        if len(self._recent) == _GROUP:
            self._paths, self._recent = [*self._paths, *self._recent], []
            self._old = scipy.spatial.cKDTree(np.concatenate(self._paths))

    def spaced(self, middles: Array) -> NDArray[np.bool_]:
        """Whether middles of paths (N, 2) have the spacing from all others."""
        if not self.count:
            return np.ones(len(middles), bool)
        apart = np.linalg.norm(middles[:, None] - self._middles, axis=-1)
        return np.asarray(apart.min(axis=1) >= self._spacing)

    def inside(self, path: Path, shifts: Array) -> NDArray[np.bool_]:
        """Whether a path moved by each of the shifts (N, 2) is inside the room."""
        if self._half is None:
            return np.ones(len(shifts), bool)
        low, high = path.box
        return np.asarray(((shifts + low >= -self._half) & (shifts + high <= self._half)).all(axis=1))

    def clear(self, path: Path, shifts: Array, humans: bool) -> NDArray[np.bool_]:
        """Whether a path moved by each of the shifts (N, 2) is away from things, and from ``humans``."""
        trees = [(self._things, _FROM_THINGS)]
        if humans:
            recent = scipy.spatial.cKDTree(np.concatenate(self._recent)) if self._recent else None
            trees += [(self._old, _FROM_HUMANS), (recent, _FROM_HUMANS)]
        free = np.ones(len(shifts), bool)
        for points in (path.points[::_COARSE], path.points):
            for tree, distance in trees:
                left = np.flatnonzero(free)
                if tree is not None and len(left):
                    at = points + shifts[left, None]
                    # points beyond the bound are at an infinite distance
                    apart = tree.query(at, distance_upper_bound=distance)[0].min(axis=1)
                    free[left] = apart >= distance
        return free
