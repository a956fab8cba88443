"""The floor of a scene: what stands on it, where people come, and whether a place is free."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import scipy
from numpy.typing import NDArray

from humansim_ros.files.mesh import Mesh, padded
from humansim_ros.motion.body import body_joints
from humansim_ros.render.device import PosedMesh, Topology
from humansim_ros.scene.config.config import SceneConfig
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.draft import Draft
from humansim_ros.scene.core.seats import Sitting, find_sittings, seat_footprint
from humansim_ros.types import Array

#: Seconds between two poses of a footprint, and most poses of a footprint.
_STEP, _MOST_POSES = 0.05, 3000
#: Seconds of the scene in which the paths of humans are known.
DURATION = 60.0
#: Metres between the points that stand for a footprint or for a thing.
_CELL = 0.05
#: Step between the points of a footprint that are compared first; most bad places show there.
_COARSE = 8
#: Sets of points after which all sets with one distance are searched as one.
_GROUP = 16
#: Heights in metres between which something is in the way of people.
_LOW, _HIGH = 0.1, 2.0
#: Times in seconds at which moving objects are in the way.
_TIMES = np.arange(0.0, DURATION, 0.5)
#: Triangles with a longer side, metres, get points between their corners, unless there are more than this.
_LONG, _MOST_LONG = 0.1, 3000


def floor_corners(config: SceneConfig, open_side: float) -> Array:
    """Low and high corner (2, 2) of the room. Without a room, of a square with a side in metres."""
    size = (open_side, open_side) if config.room is None else config.room.size[:2]
    return np.array([size, size]) * [[-0.5], [0.5]]


@dataclass(frozen=True)
class Footprint:
    """Points of the floor below a human, in all poses of its motion.

    Attributes:
        points: (F, 2) metres, where a joint, a chair or a table comes.
        joints: Points (F, 2) where a joint comes.
        feet: Points (F, 2) where an ankle comes.
        sittings: Where the human sits.
    """

    points: Array
    joints: Array
    feet: Array
    sittings: tuple[Sitting, ...] = ()

    @classmethod
    def of_cycle(cls, actor: Actor, table: bool = False) -> Footprint:
        """Footprint of one cycle of a motion. If the motion repeats, the footprint does not grow later.

        ``table``: whether a table is put in front of a human who sits.
        """
        motion = actor.motion
        length = motion.duration if np.isfinite(motion.duration) else 0.0
        count = min(_MOST_POSES, 2 + int(length / _STEP))
        # the end of a cycle is the start of the next
        return cls._of(actor, np.linspace(0.0, length * (1 - 1e-6), count) - actor.offset, table)

    @classmethod
    def of_scene(cls, actor: Actor) -> Footprint:
        """Footprint of the first minute of a scene, because a motion may travel for ever."""
        return cls._of(actor, np.arange(0.0, DURATION, 2 * _STEP))

    @classmethod
    def _of(cls, actor: Actor, times: Array, table: bool = False) -> Footprint:
        joints, names = actor.joint_paths(times), actor.human.skeleton.joint_names
        body = joints[:, body_joints(names), :2].reshape(-1, 2)
        sittings = tuple(find_sittings(joints, names, times))
        points = [body, *(seat_footprint(each, table) for each in sittings)]
        feet = joints[:, [joint for joint, name in enumerate(names) if name[2:] == "ankle"], :2]
        return cls(_on_grid(np.concatenate(points)), _on_grid(body), _on_grid(feet.reshape(-1, 2)), sittings)

    def turned(self, yaw: float) -> Footprint:
        """Footprint of a human that starts at the origin with another heading, radians to the left."""
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        sittings = tuple(replace(each, hips=each.hips @ turn, yaw=each.yaw + yaw) for each in self.sittings)
        return self._mapped(lambda points: points @ turn[:2, :2], sittings)

    def mirrored(self) -> Footprint:
        """Footprint with left and right exchanged, along +x."""
        sittings = (replace(each, hips=each.hips * (1, -1, 1), yaw=-each.yaw) for each in self.sittings)
        return self._mapped(lambda points: points * (1, -1), tuple(sittings))

    def moved(self, shift: Array) -> Footprint:
        """Footprint moved by (2,) metres, without its sittings."""
        return self._mapped(lambda points: points + shift, ())

    def _mapped(self, change: Callable[[Array], Array], sittings: tuple[Sitting, ...]) -> Footprint:
        return Footprint(change(self.points), change(self.joints), change(self.feet), sittings)

    @property
    def box(self) -> tuple[Array, Array]:
        """Low and high corner (2,)."""
        return self.points.min(axis=0), self.points.max(axis=0)

    @property
    def middle(self) -> Array:
        """Middle (2,) of its box."""
        low, high = self.box
        return np.asarray((low + high) / 2)

    @property
    def size(self) -> float:
        """Length of the diagonal of its box, metres."""
        low, high = self.box
        return float(np.linalg.norm(high - low))


def _on_grid(points: Array) -> Array:
    """Points (M, 2) 5 cm apart that stand for points (N, 2)."""
    return np.asarray(_CELL * np.unique(np.round(points / _CELL), axis=0))


@dataclass
class _Taken:
    """Points that are taken, in the order in which they were added, and the distance to keep from them."""

    distance: float
    sets: list[Array] = field(default_factory=list)
    old: tuple[int, scipy.spatial.cKDTree | None] = (0, None)
    new: tuple[int, scipy.spatial.cKDTree | None] = (0, None)

    def trees(self) -> Iterator[scipy.spatial.cKDTree]:
        """Trees that have all points: one of the older sets, and one of the newer sets."""
        count = len(self.sets)
        if count - self.old[0] >= _GROUP:
            self.old = self.new = count, scipy.spatial.cKDTree(np.concatenate(self.sets))
        if count != self.new[0]:
            self.new = count, scipy.spatial.cKDTree(np.concatenate(self.sets[self.old[0] :]))
        yield from {id(tree): tree for _, tree in (self.old, self.new) if tree is not None}.values()


class Floor:
    """A floor on which people and things are placed, inside of walls and away from what is there already.

    ``walls``: low and high corner (2, 2), metres; None for no walls.
    """

    def __init__(self, walls: Array | None = None) -> None:
        self._walls = walls
        self._taken: dict[str, _Taken] = {}

    def take(self, kind: str, points: Array, distance: float) -> None:
        """Let all that is placed later keep a distance from points.

        Args:
            kind: Name of what is there, such as ``humans``.
            points: (N, 2) in ``map``, metres.
            distance: Metres, the same for each call with a kind.
        """
        if len(points):
            self._taken.setdefault(kind, _Taken(distance)).sets.append(points)

    def inside(self, box: tuple[Array, Array], shifts: Array) -> NDArray[np.bool_]:
        """Whether a box, from corner (2,) to corner (2,), moved by shifts (N, 2) is inside the walls."""
        if self._walls is None:
            return np.ones(len(shifts), bool)
        (low, high), (left, right) = box, self._walls
        return np.asarray(((shifts + low >= left) & (shifts + high <= right)).all(axis=1))

    def clear(
        self, points: Array, shifts: Array, margin: float = 0.0, but: Sequence[str] = ()
    ) -> NDArray[np.bool_]:
        """Whether points keep the distances from all that is taken.

        Args:
            points: (P, 2) metres.
            shifts: Moves of all points, (N, 2) metres.
            margin: Metres that are added to each distance.
            but: Kinds that do not count.

        Returns:
            (N,) for each of the moves.
        """
        kinds = [taken for kind, taken in self._taken.items() if kind not in but]
        trees = [(tree, taken.distance + margin) for taken in kinds for tree in taken.trees()]
        free = np.ones(len(shifts), bool)
        for some in (points[::_COARSE], points) if len(points) > 1 else (points,):
            for tree, distance in trees:
                left = np.flatnonzero(free)
                if len(left):
                    at = some + shifts[left, None]
                    # points beyond the bound are at an infinite distance
                    apart = tree.query(at, distance_upper_bound=distance)[0].min(axis=1)
                    free[left] = apart >= distance
        return free


def footprints(draft: Draft) -> dict[str, Footprint]:
    """Footprints of all humans so far by name, in the first minute of the scene."""
    return {
        name: draft.source.once(partial(Footprint.of_scene, actor), "footprint", name)
        for name, actor in draft.actors.items()
    }


def things_on_floor(draft: Draft, area: Array) -> Array:
    """Points (M, 2), about 5 cm apart, where something stands or passes in the first minute.

    Args:
        draft: The scene. What people hold does not count.
        area: Two corners (2, 2) of the area of people. A mesh around all of it is a room: only its walls
            count.

    Raises:
        HumansimError: With the key, if a mesh cannot be read.
    """
    points = [np.zeros((0, 2)), *_furniture(draft), *_objects(draft, area)]
    points += [_seen_from_above(_samples(mesh), area) for mesh in draft.environment.mesh_files]
    return _on_grid(np.concatenate(points))


def _furniture(draft: Draft) -> Iterator[Array]:
    """Points on the furniture of the room."""
    for each in draft.furnishing.fixtures.values():
        x, y = (
            np.linspace(c - s / 2, c + s / 2, 2 + int(s / _CELL))
            for c, s in zip(each.center, each.size, strict=True)
        )
        yield np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _objects(draft: Draft, area: Array) -> Iterator[Array]:
    """Points on the objects that nobody holds, and on the robot."""
    sections = draft.config.objects
    items = [item for name, item in draft.objects.items() if sections[name].held_by is None]
    for item in items if draft.robot_body is None else [*items, draft.robot_body]:
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
    between = PosedMesh(Topology(Mesh(vertices.astype(float), padded(long))), vertices).samples[0].T
    return np.concatenate([vertices, between]).astype(float)


def _seen_from_above(points: Array, area: Array) -> Array:
    """Surface points (N, 3) that are in the way, as (M, 2)."""
    height = points[:, 2]
    in_the_way: NDArray[np.bool_] = (height > _LOW) & (height < _HIGH)
    flat = points[:, :2]
    around = len(points) and bool(
        (flat.min(axis=0) <= area.min(axis=0)).all() and (flat.max(axis=0) >= area.max(axis=0)).all()
    )
    # the top of a tall thing stands for its inside
    return flat[(height > _LOW) if in_the_way.any() and not around else in_the_way]
