"""The floor of a scene: where people sit and go, what stands on it, and whether a place is free."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import scipy
from numpy.typing import NDArray

from humansim_ros.files.mesh import Mesh, padded
from humansim_ros.motion.body import body_joints
from humansim_ros.motion.pose import true_runs
from humansim_ros.render.device import PosedMesh, Topology
from humansim_ros.scene.config.config import SceneConfig
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.environment import Fixture
from humansim_ros.scene.core.features import Draft
from humansim_ros.types import Array

#: Masses of trunk with head and arms, of both thighs, and of both shins with feet [Winter 2009, table 4.1].
_MASSES = (0.678, 0.200, 0.122)
#: A person sits if the hips are between these shares of the length of the legs above the ankles, and the
#: center of mass is behind the ankles by more than this share: nobody stands so. Children who lift something
#: from the floor reach 0.16, people on seats are above 0.30.
_LOWEST_HIPS, HIGHEST_HIPS, _BEHIND = 0.25, 0.75, 0.22
#: Hips that sit are slower than this, m/s, for at least these seconds.
_STILL, _SHORTEST = 0.15, 0.5
#: Places of one seat are nearer than this, metres.
_SAME = 0.2
#: Height of the hips of the built-in sitting motions over a seat, metres, and the height of that seat.
_FLESH, SEAT_HEIGHT = 0.09, 0.45
#: Metres from the hips of the default human to the middle of a table in front.
TO_TABLE = 0.68
_LEGS = tuple(f"{side}_{part}" for part in ("hip", "knee", "ankle") for side in "lr")
_TOP = "vl5"


@dataclass(frozen=True)
class Sitting:
    """A person who sits in one place.

    Attributes:
        time: Scene time at which it begins, seconds.
        hips: Middle of the hips, (3,) metres in ``map``.
        yaw: Heading, radians.
        size: Size of the legs relative to the built-in motions, for which a seat is 0.45 m high.
    """

    time: float
    hips: Array
    yaw: float
    size: float

    @property
    def height(self) -> float:
        """Height of a seat that fits, metres."""
        return float(self.hips[2]) - _FLESH * self.size


def find_sittings(joints: Array, names: Sequence[str], times: Array) -> list[Sitting]:
    """Places where a person sits, each once. ``joints``: joints (N, J, 3) in ``map`` at evenly spaced times.
    ``names``: names of the joints. ``times``: seconds (N,)."""
    if not {*_LEGS, _TOP} <= set(names) or len(times) < 2:
        return []
    hips, knees, ankles = (
        joints[:, [names.index(name) for name in _LEGS[part : part + 2]]].mean(axis=1) for part in (0, 2, 4)
    )
    top = joints[:, names.index(_TOP)]
    legs = np.linalg.norm(hips - knees, axis=1) + np.linalg.norm(knees - ankles, axis=1)
    length = float(np.median(_leg_lengths(joints, names)))
    ahead = (knees - hips)[:, :2]
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    trunk, thighs, shins = _MASSES
    center = trunk * (hips + 1.2 * (top - hips)) + thighs * (hips + knees) / 2 + shins * (knees + ankles) / 2
    behind = -((center - ankles)[:, :2] * ahead).sum(axis=1)
    height = (hips - ankles)[:, 2]
    speed = np.linalg.norm(np.gradient(hips, times, axis=0), axis=1)
    low = (height > _LOWEST_HIPS * length) & (height < HIGHEST_HIPS * length)
    sits: NDArray[np.bool_] = low & (behind > _BEHIND * length) & (speed < _STILL) & (legs > 0)
    found: list[Sitting] = []
    for first, last in true_runs(sits):
        if times[last] - times[first] < _SHORTEST:
            continue
        place, way = hips[first : last + 1].mean(axis=0), ahead[first : last + 1].mean(axis=0)
        if all(np.linalg.norm(place - other.hips) > _SAME for other in found):
            yaw = float(np.arctan2(way[1], way[0]))
            found.append(Sitting(float(times[first]), place, yaw, length / _STANDARD_LEG))
    return found


#: Length of the legs of the default human from hip to ankle, metres.
_STANDARD_LEG = 0.868


def _leg_lengths(joints: Array, names: Sequence[str]) -> Array:
    """Length (N,) of the legs from hip to ankle, mean of both."""
    hip, knee, ankle = (
        joints[:, [names.index(name) for name in _LEGS[part : part + 2]]] for part in (0, 2, 4)
    )
    length = np.linalg.norm(hip - knee, axis=-1) + np.linalg.norm(knee - ankle, axis=-1)
    return np.asarray(length.mean(axis=1))


def seat_footprint(sitting: Sitting, table: bool) -> Array:
    """Points (M, 2) 5 cm apart on the floor below the chair of a person who sits, and below the table."""
    boxes = [(0.0, 0.44, 0.43), *([(TO_TABLE * sitting.size, 0.8, 1.6)] if table else [])]
    points = []
    for ahead, depth, width in boxes:
        x, y = (np.arange(-side / 2, side / 2 + 0.05, 0.05) for side in (depth, width))
        points.append(np.stack(np.meshgrid(x + ahead, y), axis=-1).reshape(-1, 2))
    c, s = np.cos(sitting.yaw), np.sin(sitting.yaw)
    return np.asarray(np.concatenate(points) @ np.array([[c, s], [-s, c]]) + sitting.hips[:2])


#: Half of the distance between the two places of a sofa, and hips behind its front edge, metres.
_SOFA_PLACES, _SOFA_DEPTH = 0.5, 0.375
#: A seat fits a person if it is too low, or too high, by less than this, metres: cushions give way by little.
_LOWER, _HIGHER = 0.07, 0.045


@dataclass(frozen=True)
class Seat:
    """A place of a chair of the scene, or of the sofa of the room.

    Attributes:
        place: Middle of the hips of the default human on the seat, (2,) metres in ``map``.
        yaw: Heading of a person on the seat, radians.
        height: Height of the seat, metres.
        middle: Middle of the chair or sofa, (2,).
        size: Its sides along the heading and across, (2,) metres.
        depth: Metres from ``place`` to the front edge, where knees bend; 0 for a shallow seat.
    """

    place: Array
    yaw: float
    height: float
    middle: Array
    size: Array
    depth: float = 0.0

    def place_of(self, sitting: Sitting) -> Array:
        """Middle of the hips (2,) of a person. Small people sit nearer to the edge."""
        ahead = self.depth * (1 - sitting.size)
        return self.place + ahead * np.array([np.cos(self.yaw), np.sin(self.yaw)])

    def covers(self, points: Array, margin: float = 0.05) -> NDArray[np.bool_]:
        """Whether points (N, 2) are above the chair or sofa, or next to it by a margin in metres."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        own = (points - self.middle) @ np.array([[c, -s], [s, c]])
        return np.asarray((np.abs(own) < self.size / 2 + margin).all(axis=1))

    def fits(self, sitting: Sitting) -> bool:
        """Whether its height is right for a person who sits."""
        return -_LOWER < self.height - sitting.height < _HIGHER


def seats_of(config: SceneConfig, fixtures: Mapping[str, Fixture]) -> list[Seat]:
    """Chairs that stand on the floor of a scene, and both places of the sofa of its room. ``fixtures``:
    furniture of the room by name."""
    found = []
    for item in config.objects.values():
        level = item.rotation_deg[:2] == (0.0, 0.0) and abs(item.position[2]) < 0.02
        if item.mesh == "chair" and level and item.keyframes is None and item.held_by is None:
            middle, size = np.array(item.position[:2]), np.array(item.size[:2]) * (0.44, 0.43)
            height = item.position[2] + SEAT_HEIGHT * item.size[2]
            found.append(Seat(middle, float(np.radians(item.rotation_deg[2])), height, middle, size))
    if (sofa := fixtures.get("sofa")) is not None and sofa.top is not None:
        (x, y), (depth, width), top = sofa.center, sofa.size, sofa.top
        middle, hips = np.array([x, y]), x + depth / 2 - _SOFA_DEPTH
        for side in (-_SOFA_PLACES, _SOFA_PLACES):
            place, size = np.array([hips, y + side]), np.array([depth, width])
            found.append(Seat(place, 0.0, top, middle, size, _SOFA_DEPTH))
    return found


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
        ``table``: whether a table is put in front of a human who sits."""
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
        HumansimError: A mesh cannot be read. The error names the key.
    """
    points = [np.zeros((0, 2)), *_furniture(draft), *_objects(draft, area)]
    points += [_seen_from_above(_samples(mesh), area) for mesh in draft.environment.mesh_files]
    return _on_grid(np.concatenate(points))


def _furniture(draft: Draft) -> Iterator[Array]:
    """Points on the furniture of the room."""
    for each in draft.furnishing.fixtures.values():
        sides = zip(each.center, each.size, strict=True)
        x, y = (np.linspace(c - s / 2, c + s / 2, 2 + int(s / _CELL)) for c, s in sides)
        yield np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _objects(draft: Draft, area: Array) -> Iterator[Array]:
    """Points on the objects that nobody holds, and on the robot."""
    sections = draft.config.objects
    items = [
        item for name, item in draft.objects.items() if name not in sections or sections[name].held_by is None
    ]
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
