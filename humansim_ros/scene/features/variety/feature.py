"""Random humans: bodies, outfits, motions and places; the same seed gives the same humans."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from humansim_ros.body.joint_names import body_joints
from humansim_ros.errors import HumansimError, HumansimWarning, SceneError, in_section, some_of
from humansim_ros.humans.human import Human
from humansim_ros.humans.makehuman.population import PeopleLimits, person_name
from humansim_ros.io.assets import built_in_names
from humansim_ros.mesh.mesh import Mesh, padded
from humansim_ros.motion.activity import ACTIVITY, needs_table
from humansim_ros.render.mesh_buffers import PosedMesh, Topology
from humansim_ros.scene.actor import Actor
from humansim_ros.scene.config import HumanConfig, MotionConfig, SceneConfig, living_face
from humansim_ros.scene.draft import Draft
from humansim_ros.scene.features import Feature
from humansim_ros.scene.features.variety.keys import VarietyConfig
from humansim_ros.scene.names import variety_names
from humansim_ros.scene.randomise import RandomNumbers, random_numbers
from humansim_ros.scene.room import furniture_plan
from humansim_ros.scene.seats import Seat, Sitting, find_sittings, footprint, seats_of
from humansim_ros.scene.source import SceneSource
from humansim_ros.types import Array

#: Least distances in metres of joints, which are inside the body, from walls, things and joints of others.
_FROM_WALLS, _FROM_THINGS, _FROM_HUMANS = 0.2, 0.2, 0.2
#: Seconds between two poses of a path, and most poses of a path.
_STEP, _MOST_POSES = 0.05, 3000
#: Seconds of the scene in which the paths of the scene's own humans are known.
_DURATION = 60.0
#: Metres from the hips of who sits to what of them is above the seat.
_SEATED = 0.5
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
        points: (F, 2) metres, where one joint or more comes, or a chair or a table is.
        joints: (F, 2) those of the points where a joint comes.
        feet: (F, 2) those of the points where an ankle comes.
        sittings: Where the human sits.
    """

    points: Array
    joints: Array
    feet: Array
    sittings: tuple[Sitting, ...] = ()

    @classmethod
    def of_cycle(cls, actor: Actor, table: bool = False) -> Path:
        """Path of one cycle of a motion; the path of a motion that repeats does not grow after it.

        ``table``: whether a table is put in front of who sits.
        """
        motion = actor.motion
        length = motion.duration if np.isfinite(motion.duration) else 0.0
        count = min(_MOST_POSES, 2 + int(length / _STEP))
        # the end of a cycle is the start of the next
        return cls._of(actor, np.linspace(0.0, length * (1 - 1e-6), count) - actor.offset, table)

    @classmethod
    def of_scene(cls, actor: Actor) -> Path:
        """Path in the first minute of a scene, as a motion may travel for ever."""
        return cls._of(actor, np.arange(0.0, _DURATION, 2 * _STEP))

    @classmethod
    def _of(cls, actor: Actor, times: Array, table: bool = False) -> Path:
        joints, names = actor.joint_paths(times), actor.human.skeleton.joint_names
        body = joints[:, body_joints(names), :2].reshape(-1, 2)
        sittings = tuple(find_sittings(joints, names, times))
        points = [body, *(footprint(each, table) for each in sittings)]
        feet = joints[:, [joint for joint, name in enumerate(names) if name[2:] == "ankle"], :2]
        return cls(_on_grid(np.concatenate(points)), _on_grid(body), _on_grid(feet.reshape(-1, 2)), sittings)

    def turned(self, yaw: float) -> Path:
        """The path of a human that starts at the origin with another heading, radians to the left."""
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        sittings = tuple(replace(each, hips=each.hips @ turn, yaw=each.yaw + yaw) for each in self.sittings)
        return self._mapped(lambda points: points @ turn[:2, :2], sittings)

    def mirrored(self) -> Path:
        """The path with left and right exchanged, along +x."""
        sittings = (replace(each, hips=each.hips * (1, -1, 1), yaw=-each.yaw) for each in self.sittings)
        return self._mapped(lambda points: points * (1, -1), tuple(sittings))

    def moved(self, shift: Array) -> Path:
        """The path moved by (2,) metres, without its sittings."""
        return self._mapped(lambda points: points + shift, ())

    def _mapped(self, change: Callable[[Array], Array], sittings: tuple[Sitting, ...]) -> Path:
        return Path(change(self.points), change(self.joints), change(self.feet), sittings)

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


def _on_grid(points: Array) -> Array:
    """Points (M, 2) 5 cm apart that stand for points (N, 2)."""
    return np.asarray(_CELL * np.unique(np.round(points / _CELL), axis=0))


class Floor:
    """Floor of a scene, with everything that stands on it.

    Args:
        room: Size (x, y) of the room around the origin, metres; None for no walls.
        things: (M, 2) points that are covered by furniture and objects, about 5 cm apart.
        spacing: Least distance of the middles of two paths, metres.
    """

    def __init__(self, room: Sequence[float] | None, things: Array, spacing: float) -> None:
        self._half = None if room is None else np.array(room[:2]) / 2 - _FROM_WALLS
        self._points = things
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

    def clear(self, path: Path, shifts: Array, humans: bool, things: bool = True) -> NDArray[np.bool_]:
        """Whether a path is away from all else.

        Args:
            path: The path.
            shifts: Moves of the path, (N, 2) metres.
            humans: Keep away from the paths of humans.
            things: Keep away from furniture and objects.

        Returns:
            (N,) for each of the moves.
        """
        trees = [(self._things, _FROM_THINGS)] if things else []
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

    def offers(self, seat: Seat, path: Path) -> bool:
        """Whether a seat is free for a human that sits there, and the rest of its path is free."""
        over = seat.covers(path.joints)
        if (np.linalg.norm(path.joints[over] - seat.place, axis=1) > _SEATED).any():
            return False  # it walks through the seat as well
        if seat.covers(path.feet, margin=0.0).any():
            return False  # it stands where the seat is
        own = replace(path, points=path.joints)
        stay = np.zeros((1, 2))
        if not (self.inside(own, stay).all() and self.clear(own, stay, humans=True, things=False).all()):
            return False
        others = self._points[~seat.covers(self._points)]
        if not len(others) or over.all():
            return True
        apart = scipy.spatial.cKDTree(others).query(path.joints[~over])[0]
        return bool(apart.min() >= _FROM_THINGS)


#: Metres between points.
#: Heights in metres between which something is in the way of people.
_LOW, _HIGH = 0.1, 2.0
#: Times in seconds at which moving objects are in the way.
_TIMES = np.arange(0.0, 60.0, 0.5)
#: Triangles with a longer side, metres, get points between their corners, unless there are more than this.
_LONG, _MOST_LONG = 0.1, 3000


def things_on_floor(draft: Draft, area: Array) -> Array:
    """Points (M, 2), about 5 cm apart, where something stands or, in the first minute, passes.

    Args:
        draft: The scene. What people hold does not count.
        area: Two corners (2, 2) of the area of people. A mesh around all of it is a room: only its walls
            count.

    Raises:
        HumansimError: With the key, if a mesh cannot be read.
    """
    points = [np.zeros((0, 2)), *_furniture(draft.config), *_objects(draft, area)]
    points += [_seen_from_above(_samples(mesh), area) for mesh in draft.environment.mesh_files]
    return _on_grid(np.concatenate(points))


def _furniture(config: SceneConfig) -> Iterator[Array]:
    """Points on the furniture of the room."""
    if config.room is None:
        return
    for center, size in furniture_plan(config.room.size[:2]).values():
        x, y = (
            np.linspace(c - s / 2, c + s / 2, 2 + int(s / _CELL)) for c, s in zip(center, size, strict=True)
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


#: Built-in motions that can be repeated without a visible jump.
MOTIONS = ("walk", "run", "wave", "pick_up", "sit_stand", "turn_in_place")
#: Metres from the walls of a room to the middles of paths, if no area is given.
_MARGIN = 1.0
#: Places tried for a human with one motion: headings, and positions for each; factor of the headings for the
#: smallest motion when none fits; positions of the last resort.
_HEADINGS, _POSITIONS, _THOROUGHLY, _TRIES = 12, 24, 10, 2000
#: Activities of its own that are tried for a human.
_ACTIVITIES = 4
#: Built-in motions that stay in place, and humans that a warning names.
_IN_PLACE = ("wave", "turn_in_place")
Item = TypeVar("Item")


@dataclass
class _Placing:
    """Random humans that are drawn one after the other.

    Attributes:
        variety: The section ``variety``.
        area: x, y of two corners: the middles of all paths are in it.
        floor: Floor with everything placed so far.
        source: Finds bodies and motions.
        paths: Paths so far from the origin along +x, by body and motion.
        crossing: Names of the humans that found no free place.
        drawn: Bodies of all humans so far.
        seats: Free seats of the scene, if people take them.
    """

    variety: VarietyConfig
    area: tuple[tuple[float, float], tuple[float, float]]
    floor: Floor
    source: SceneSource
    paths: dict[tuple[str, str], Path] = field(default_factory=dict)
    crossing: list[str] = field(default_factory=list)
    drawn: list[str] = field(default_factory=list)
    seats: list[Seat] = field(default_factory=list)

    @classmethod
    def of_scene(cls, draft: Draft, variety: VarietyConfig) -> _Placing:
        """Nobody yet, besides the scene's own humans and things."""
        area, room = _area(variety, draft.config), draft.config.room
        things = things_on_floor(draft, np.array(area))
        floor = Floor(None if room is None else room.size, things, variety.spacing)
        for actor in draft.actors.values():
            floor.add(Path.of_scene(actor))
        seats = seats_of(draft.config) if variety.seats == "scene" else []
        return cls(variety, area, floor, draft.source, seats=seats)

    def draw(self, name: str) -> HumanConfig:
        """The next human. Raises SceneError with the key."""
        variety, uniform = self.variety, random_numbers(self.variety.seed, name)
        share = uniform()
        if variety.people is None:
            body = _one_of(variety.bodies or built_in_names("humans"), share)
        else:
            body = person_name(variety.seed, len(self.drawn), PeopleLimits(**dict(variety.people)))
        self.drawn.append(body)
        outfit = _one_of(self._body(body).outfits, uniform())
        motions = self._own_activities(name, _order(variety.motions or MOTIONS, uniform))
        ahead, mirror = 10 * uniform(), uniform() < 0.5
        low, high = variety.speed
        speed = low + (high - low) * uniform()
        motion, position, yaw = self._find_place(name, body, motions, mirror, uniform)
        return HumanConfig(
            body=body,
            outfit=outfit,
            motion=MotionConfig(
                file=motion,
                position=position,
                yaw_deg=yaw,
                offset=round(ahead, 3),
                speed=round(speed, 4),
                mirror=mirror,
            ),
            face=living_face(variety.alive, variety.seed),
        )

    def _own_activities(self, name: str, motions: Sequence[str]) -> list[str]:
        """Motions with activities of a human's own in place of ``activity``; one may need less floor."""
        uniform = random_numbers(self.variety.seed, f"{name} {ACTIVITY}")
        own = [f"{ACTIVITY}#{int(1e6 * uniform())}" for _ in range(_ACTIVITIES)]
        return [each for motion in motions for each in (own if motion == ACTIVITY else [motion])]

    def _find_place(
        self, name: str, body: str, motions: Sequence[str], mirror: bool, uniform: RandomNumbers
    ) -> tuple[str, tuple[float, float], float]:
        """Motion, start position and heading in degrees. ``motions``: in the order of their trial."""
        if self.seats and (taken := self._take_seat(motions[0], body, mirror, uniform)) is not None:
            return taken
        for motion in motions:
            place = self._try(self._path(body, motion, mirror), uniform)
            if place is not None:
                return self._place(name, motion, *place, free=True)
        paths = {motion: self._path(body, motion, mirror) for motion in motions}
        smallest = min(motions, key=lambda motion: paths[motion].size)
        for humans, thoroughly in ((True, _THOROUGHLY), (False, 1)):
            place = self._try(paths[smallest], uniform, humans, thoroughly)
            if place is not None:
                return self._place(name, smallest, *place, free=humans)
        yaw = round(360 * uniform() - 180, 3)
        path = paths[smallest].turned(math.radians(yaw))
        shifts = self._shifts(_TRIES, path, uniform)
        if not len(shifts):
            raise SceneError(
                f"the area has {self.floor.count} humans already, and {name} finds no position "
                f"{self.variety.spacing:g} m from all of them: give a larger area, a smaller spacing, or "
                "fewer humans",
                key="variety.count",
            )
        return self._place(name, smallest, path, shifts[0], yaw, free=False)

    def _take_seat(
        self, motion: str, body: str, mirror: bool, uniform: RandomNumbers
    ) -> tuple[str, tuple[float, float], float] | None:
        """Motion, start position and heading in degrees of who takes a free seat; None if there is none.

        Who needs a table brings it, and the chair with it.
        """
        origin = self._path(body, motion, mirror)
        if len(origin.sittings) != 1 or needs_table(motion):
            return None
        (sitting,) = origin.sittings
        for _, number in sorted((uniform(), number) for number in range(len(self.seats))):
            seat = self.seats[number]
            yaw = round(math.degrees(seat.yaw - sitting.yaw), 3)
            turned = origin.turned(math.radians(yaw))
            shift = seat.place_of(sitting) - turned.sittings[0].hips[:2]
            path = turned.moved(shift)
            if seat.fits(sitting) and self.floor.offers(seat, path):
                del self.seats[number]
                x, y = shift.tolist()
                self.floor.add(replace(path, points=path.joints))
                return motion, (round(x, 4), round(y, 4)), yaw
        return None

    def _try(
        self, origin: Path, uniform: RandomNumbers, humans: bool = True, thoroughly: int = 1
    ) -> tuple[Path, Array, float] | None:
        """A free place for a path: the turned path, its move (2,) and its heading; None if none is found.

        ``origin``: the path from the origin along +x. ``humans``: keep away from the paths of others.
        ``thoroughly``: factor of the number of tries.
        """
        for _ in range(_HEADINGS * thoroughly):
            yaw = round(360 * uniform() - 180, 3)
            path = origin.turned(math.radians(yaw))
            shifts = self._shifts(_POSITIONS, path, uniform)
            shifts = shifts[self.floor.inside(path, shifts)]
            shifts = shifts[self.floor.clear(path, shifts, humans)]
            if len(shifts):
                return path, shifts[0], yaw
        return None

    def _shifts(self, count: int, path: Path, uniform: RandomNumbers) -> Array:
        """``count`` random moves (N, 2) of a path into the area, without those that break the spacing."""
        (x0, y0), (x1, y1) = self.area
        middles = [(x0 + (x1 - x0) * uniform(), y0 + (y1 - y0) * uniform()) for _ in range(count)]
        shifts = np.array(middles) - path.middle
        return shifts[self.floor.spaced(np.array(middles))]

    def _place(
        self, name: str, motion: str, path: Path, shift: Array, yaw: float, free: bool
    ) -> tuple[str, tuple[float, float], float]:
        """Put a path with its heading (``yaw``, degrees) on the floor, moved by a shift (2,)."""
        self.floor.add(path.moved(shift))
        if not free:
            self.crossing.append(name)
        return motion, (round(float(shift[0]), 4), round(float(shift[1]), 4)), yaw

    def _body(self, name: str) -> Human:
        with in_section("variety"):
            return self.source.human(name, key="bodies" if self.variety.people is None else "people")

    def _path(self, body: str, motion: str, mirror: bool) -> Path:
        """Path from the origin along +x. Raises HumansimError if the human cannot play the motion."""
        if (body, motion) not in self.paths:
            config = MotionConfig(file=motion)
            try:
                actor = Actor.build("", 1, self._body(body), config, self.source)
            except HumansimError as error:
                raise type(error)(error.message, key="variety.motions") from error.__cause__
            self.paths[body, motion] = Path.of_cycle(actor, needs_table(motion))
        path = self.paths[body, motion]
        return path.mirrored() if mirror else path


def _area(variety: VarietyConfig, config: SceneConfig) -> tuple[tuple[float, float], tuple[float, float]]:
    """Two corners of the area of the humans: as configured, else the middle of the room."""
    if variety.area is not None:
        return variety.area[:2], variety.area[2:]
    size = (6.0, 6.0) if config.room is None else config.room.size[:2]
    x, y = (max(side / 2 - _MARGIN, 0.3) for side in size)
    return (-x, -y), (x, y)


def _one_of(items: Sequence[Item], share: float) -> Item:
    return items[min(int(share * len(items)), len(items) - 1)]


def _order(motions: Sequence[str], uniform: RandomNumbers) -> list[str]:
    """One of the motions, then the others in random order: a motion listed twice is first twice as often."""
    first = _one_of(motions, uniform())
    others = sorted(set(motions) - {first})
    return [first, *(name for _, name in sorted((uniform(), name) for name in others))]


class Variety(Feature):
    """The section ``variety``."""

    def expand(self, draft: Draft) -> None:
        """Add the random humans of the section ``variety``.

        The path of each human is inside the room and away from furniture, objects and the paths of all
        others. If a motion finds no such place, the human gets another motion. A HumansimWarning names
        the humans that find no place with any motion.

        A human depends on the seed and its number only: more humans do not change the first ones.

        Raises:
            SceneError: With the key, if there is no space for the humans.
        """
        variety = draft.config.variety
        assert variety is not None
        humans, crossing = dict(draft.config.humans), []
        if variety.count:
            placing = _Placing.of_scene(draft, variety)
            for name in variety_names(variety.name, variety.count):
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", HumansimWarning)  # of motions that are only tried
                    humans[name] = placing.draw(name)
                draft.add_human(name, humans[name])
            crossing = placing.crossing
        draft.config = draft.config.model_copy(update={"humans": humans, "variety": None})
        if crossing:
            draft.source.warn(
                "variety",
                f"no free place for {some_of(crossing)}: they walk through other people, "
                "furniture or walls. Give fewer people (count), a larger area or room, or motions that stay "
                f"in place, such as {' and '.join(_IN_PLACE)} (motions)",
            )


FEATURE = Variety()
