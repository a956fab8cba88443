"""Random humans: bodies, outfits, motions and places; the same seed gives the same humans."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from humansim_ros.errors import HumansimError, HumansimWarning, SceneError, in_section, some_of
from humansim_ros.files.reading import built_in_names
from humansim_ros.motion.files import ACTIVITY, needs_table
from humansim_ros.people.humans import Human
from humansim_ros.people.makehuman import person_name
from humansim_ros.scene.config.config import HumanConfig, MotionConfig, SceneConfig
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.features import Draft, Feature
from humansim_ros.scene.core.floor import (
    Floor,
    Footprint,
    Seat,
    floor_corners,
    footprints,
    seats_of,
    things_on_floor,
)
from humansim_ros.scene.core.looks import RandomNumbers, random_numbers
from humansim_ros.scene.core.names import variety_names
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.features.face import living_face
from humansim_ros.scene.features.variety import VarietyConfig
from humansim_ros.types import Array

#: Least distances in metres of joints, which are inside the body, from walls, things and joints of others.
_FROM_WALLS, _FROM_THINGS, _FROM_HUMANS = 0.2, 0.2, 0.2
#: Joints of a person who sits are above the seat up to this distance from its place, metres.
_SEATED = 0.5
#: Built-in motions that can be repeated without a visible jump.
MOTIONS = ("walk", "run", "wave", "pick_up", "sit_stand", "turn_in_place")
#: Metres from the walls of a room to the middles of paths, if no area is given.
_MARGIN = 1.0
#: Side in metres of the square that stands for the room if there is none.
_OPEN = 6.0
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
        area: Low and high corner (2, 2). The middles of all footprints are in it.
        floor: Floor with everything placed so far.
        things: Points (M, 2) of furniture and objects.
        source: Finds bodies and motions.
        middles: Middles (N, 2) of the footprints of all humans so far.
        paths: Footprints so far from the origin along +x, by body and motion.
        crossing: Names of the humans that found no free place.
        drawn: Bodies of all humans so far.
        seats: Free seats of the scene, if people take them.
    """

    variety: VarietyConfig
    area: Array
    floor: Floor
    things: Array
    source: SceneSource
    middles: Array = field(default_factory=lambda: np.zeros((0, 2)))
    paths: dict[tuple[str, str], Footprint] = field(default_factory=dict)
    crossing: list[str] = field(default_factory=list)
    drawn: list[str] = field(default_factory=list)
    seats: list[Seat] = field(default_factory=list)

    @classmethod
    def of_scene(cls, draft: Draft, variety: VarietyConfig) -> _Placing:
        """Nobody yet, besides the scene's own humans and things."""
        config, area = draft.config, _area(variety, draft.config)
        walls = floor_corners(config, 0.0) - [[-_FROM_WALLS], [_FROM_WALLS]]
        floor, things = Floor(None if config.room is None else walls), things_on_floor(draft, area)
        floor.take("things", things, _FROM_THINGS)
        seats = seats_of(config, draft.furnishing.fixtures) if variety.seats == "scene" else []
        placing = cls(variety, area, floor, things, draft.source, seats=seats)
        for footprint in footprints(draft).values():
            placing.add(footprint)
        return placing

    def add(self, footprint: Footprint) -> None:
        """Keep away from a human from now on."""
        self.middles = np.vstack([self.middles, footprint.middle])
        self.floor.take("humans", footprint.points, _FROM_HUMANS)

    def draw(self, name: str) -> HumanConfig:
        """The next human. Raises SceneError, which names the key."""
        variety, uniform = self.variety, random_numbers(self.variety.seed, name)
        share = uniform()
        if variety.people is None:
            body = _one_of(variety.bodies or built_in_names("humans"), share)
        else:
            body = person_name(variety.seed, len(self.drawn), variety.people)
        self.drawn.append(body)
        outfit = _one_of(self._body(body).outfits, uniform())
        motions = self._own_activities(name, _order(variety.motions or MOTIONS, uniform))
        ahead, mirror = 10 * uniform(), uniform() < 0.5
        low, high = variety.speed
        speed = low + (high - low) * uniform()
        motion, position, yaw = self._find_place(name, body, motions, mirror, uniform)
        ahead, speed = round(ahead, 3), round(speed, 4)
        played = MotionConfig(
            file=motion, position=position, yaw_deg=yaw, offset=ahead, speed=speed, mirror=mirror
        )
        face = living_face(variety.alive, variety.seed)
        return HumanConfig(body=body, outfit=outfit, motion=played, face=face)

    def _own_activities(self, name: str, motions: Sequence[str]) -> list[str]:
        """Motions, with several own activities in place of ``activity``: one of them may need less floor."""
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
                f"the area has {len(self.middles)} humans already, and {name} finds no position "
                f"{self.variety.spacing:g} m from all of them: give a larger area, a smaller spacing, or "
                "fewer humans",
                key="variety.count",
            )
        return self._place(name, smallest, path, shifts[0], yaw, free=False)

    def _take_seat(
        self, motion: str, body: str, mirror: bool, uniform: RandomNumbers
    ) -> tuple[str, tuple[float, float], float] | None:
        """Motion, start position and heading in degrees of a human on a free seat; None without a free seat.

        A human who needs a table gets a chair and a table later.
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
            if seat.fits(sitting) and self._offers(seat, path):
                del self.seats[number]
                x, y = shift.tolist()
                self.add(replace(path, points=path.joints))
                return motion, (round(x, 4), round(y, 4)), yaw
        return None

    def _try(
        self, origin: Footprint, uniform: RandomNumbers, humans: bool = True, thoroughly: int = 1
    ) -> tuple[Footprint, Array, float] | None:
        """Find a free place: the turned path, its move (2,) and its heading; None if all tries fail.

        ``origin``: the path from the origin along +x. ``humans``: keep away from the paths of others.
        ``thoroughly``: factor of the number of tries.
        """
        for _ in range(_HEADINGS * thoroughly):
            yaw = round(360 * uniform() - 180, 3)
            path = origin.turned(math.radians(yaw))
            shifts = self._shifts(_POSITIONS, path, uniform)
            shifts = shifts[self.floor.inside(path.box, shifts)]
            shifts = shifts[self.floor.clear(path.points, shifts, but=() if humans else ("humans",))]
            if len(shifts):
                return path, shifts[0], yaw
        return None

    def _shifts(self, count: int, path: Footprint, uniform: RandomNumbers) -> Array:
        """``count`` random moves (N, 2) of a path into the area, without those that break the spacing."""
        (x0, y0), (x1, y1) = self.area.tolist()
        middles = [(x0 + (x1 - x0) * uniform(), y0 + (y1 - y0) * uniform()) for _ in range(count)]
        shifts = np.array(middles) - path.middle
        return shifts[self._spaced(np.array(middles))]

    def _spaced(self, middles: Array) -> NDArray[np.bool_]:
        """Whether middles of footprints (N, 2) have the spacing from all others."""
        if not len(self.middles):
            return np.ones(len(middles), bool)
        apart = np.linalg.norm(middles[:, None] - self.middles, axis=-1)
        return np.asarray(apart.min(axis=1) >= self.variety.spacing)

    def _offers(self, seat: Seat, path: Footprint) -> bool:
        """Whether a seat is free for a human that sits there, and the rest of its path is free."""
        over = seat.covers(path.joints)
        if (np.linalg.norm(path.joints[over] - seat.place, axis=1) > _SEATED).any():
            return False  # it walks through the seat as well
        if seat.covers(path.feet, margin=0.0).any():
            return False  # it stands where the seat is
        box, stay = (path.joints.min(axis=0), path.joints.max(axis=0)), np.zeros((1, 2))
        if not (self.floor.inside(box, stay) & self.floor.clear(path.joints, stay, but=("things",))).all():
            return False
        others = self.things[~seat.covers(self.things)]
        if not len(others) or over.all():
            return True
        apart = scipy.spatial.cKDTree(others).query(path.joints[~over])[0]
        return bool(apart.min() >= _FROM_THINGS)

    def _place(
        self, name: str, motion: str, path: Footprint, shift: Array, yaw: float, free: bool
    ) -> tuple[str, tuple[float, float], float]:
        """Put a path with its heading (``yaw``, degrees) on the floor, moved by a shift (2,)."""
        self.add(path.moved(shift))
        if not free:
            self.crossing.append(name)
        return motion, (round(float(shift[0]), 4), round(float(shift[1]), 4)), yaw

    def _body(self, name: str) -> Human:
        with in_section("variety"):
            return self.source.human(name, key="bodies" if self.variety.people is None else "people")

    def _path(self, body: str, motion: str, mirror: bool) -> Footprint:
        """Path from the origin along +x. Raises HumansimError if the human cannot play the motion."""
        if (body, motion) not in self.paths:
            config = MotionConfig(file=motion)
            try:
                actor = Actor.build("", 1, self._body(body), config, self.source)
            except HumansimError as error:
                raise type(error)(error.message, key="variety.motions") from error.__cause__
            self.paths[body, motion] = Footprint.of_cycle(actor, needs_table(motion))
        path = self.paths[body, motion]
        return path.mirrored() if mirror else path


def _area(variety: VarietyConfig, config: SceneConfig) -> Array:
    """Two corners (2, 2) of the area of the humans: as configured, else the middle of the room."""
    if variety.area is not None:
        return np.reshape(variety.area, (2, 2))
    high = np.maximum(floor_corners(config, _OPEN)[1] - _MARGIN, 0.3)
    return np.array([-high, high])


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
            SceneError: The humans find no space. The error names the key.
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
