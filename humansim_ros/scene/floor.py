"""The floor of a scene: what stands on it, and where random humans walk without touching it or each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from humansim_ros.errors import in_section
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.motion.keyframes import KeyframeTrack
from humansim_ros.render.mesh_buffers import PosedMesh, Topology
from humansim_ros.scene.actor import Actor
from humansim_ros.scene.config import SceneConfig
from humansim_ros.scene.environment import mesh_files
from humansim_ros.scene.objects import SceneObject
from humansim_ros.scene.room import furniture_plan
from humansim_ros.scene.source import SceneSource
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


#: Metres between points.
#: Heights in metres between which something is in the way of people.
_LOW, _HIGH = 0.1, 2.0
#: Times in seconds at which moving objects are in the way.
_TIMES = np.arange(0.0, 60.0, 0.5)
#: Triangles with a longer side, metres, get points between their corners, unless there are more than this.
_LONG, _MOST_LONG = 0.1, 3000


def things_on_floor(
    config: SceneConfig,
    source: SceneSource,
    tracks: Mapping[tuple[str, str], KeyframeTrack],
    area: Array,
) -> Array:
    """Points (M, 2), about 5 cm apart, where something stands or, in the first minute, passes.

    Args:
        config: The scene.
        source: Finds mesh files.
        tracks: Keyframes by section and name.
        area: Two corners (2, 2) of the area of people. A mesh around all of it is a room: only its walls
            count.

    Raises:
        HumansimError: With the key, if a mesh cannot be read.
    """
    points = [np.zeros((0, 2)), *_furniture(config), *_objects(config, source, tracks, area)]
    points += [_seen_from_above(_samples(mesh), area) for mesh in mesh_files(config, source)]
    return _CELL * np.unique(np.round(np.concatenate(points) / _CELL), axis=0)


def _furniture(config: SceneConfig) -> Iterator[Array]:
    """Points on the furniture of the room."""
    if config.room is None:
        return
    for center, size in furniture_plan(config.room.size[:2]).values():
        x, y = (
            np.linspace(c - s / 2, c + s / 2, 2 + int(s / _CELL)) for c, s in zip(center, size, strict=True)
        )
        yield np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _objects(
    config: SceneConfig,
    source: SceneSource,
    tracks: Mapping[tuple[str, str], KeyframeTrack],
    area: Array,
) -> Iterator[Array]:
    for name, section in config.objects.items():
        with in_section(f"objects.{name}"):
            item = SceneObject.build(name, section, source, tracks.get(("objects", name)), 0)
        if not item.moves:
            yield _seen_from_above(_samples(item.static_mesh()), area)
            continue
        points = _samples(item.mesh)
        points = points[:: 1 + len(points) // 1000]
        for time in _TIMES.tolist():
            yield _seen_from_above(item.at(time).apply(points), area)


def _samples(mesh: Mesh) -> Array:
    """Points (N, 3) on the surface."""
    vertices = np.asarray(mesh.vertices, dtype=np.float32)
    corners = vertices[mesh.triangles]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    long = mesh.triangles[(sides > _LONG).any(axis=1)]
    if not 0 < len(long) <= _MOST_LONG:
        return vertices.astype(float)
    faces = np.pad(long, ((0, 0), (0, 1)), constant_values=-1)
    between = PosedMesh(Topology(Mesh(vertices.astype(float), faces)), vertices).samples[0].T
    return np.concatenate([vertices, between]).astype(float)


def _seen_from_above(points: Array, area: Array) -> Array:
    """Those of the surface points (N, 3) that are in the way, as (M, 2)."""
    height = points[:, 2]
    in_the_way: NDArray[np.bool_] = (height > _LOW) & (height < _HIGH)
    flat = points[:, :2]
    around = len(points) and bool(
        (flat.min(axis=0) <= area.min(axis=0)).all() and (flat.max(axis=0) >= area.max(axis=0)).all()
    )
    # the top of a tall thing stands for its inside
    return flat[(height > _LOW) if in_the_way.any() and not around else in_the_way]
