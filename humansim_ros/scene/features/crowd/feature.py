"""People who walk among each other: goals, groups and queues from a seed, planned with ORCA.

The plan is made once, for a round of some seconds: at its end everybody is back at the start. So the round
repeats without a jump, and any time can be asked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy.spatial
from numpy.typing import NDArray

from humansim_ros.errors import HumansimError, SceneError, in_section, some_of
from humansim_ros.files.reading import built_in_names
from humansim_ros.motion.pose import WalkPath
from humansim_ros.scene.config.config import HumanConfig, MotionConfig, SceneConfig
from humansim_ros.scene.core.features import Draft, Feature
from humansim_ros.scene.core.floor import floor_corners, footprints, things_on_floor
from humansim_ros.scene.core.looks import RandomNumbers, random_numbers
from humansim_ros.scene.core.names import variety_names
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.features.crowd import CrowdConfig
from humansim_ros.scene.features.crowd.walking import Walkers, WalkGrid
from humansim_ros.scene.features.face import living_face
from humansim_ros.types import Array

#: Seconds between two velocities, and seconds in which nobody collides.
STEP, _HORIZON = 0.2, 2.5
#: Largest change of a velocity in a second, m/s, and of its direction, radians.
_ACCELERATION, _TURN = 4.0, 2.0
#: Metres from a goal at which it is reached, of people who pass it and of people who stay there.
_PASSED, _ARRIVED = 0.5, 0.05
#: Seconds without this progress, metres, after which somebody looks for another goal.
_PATIENCE, _PROGRESS = 6.0, 0.3
#: Factor of the time of the way home, and seconds that are added, for the others on it.
_HOMEWARDS, _STANDING = 1.6, 5.0
#: A round ends after at most this factor of its duration, whoever is not back.
_LONGER = 1.5
#: Sizes of groups, metres between people who walk side by side, and how far the outer ones fall back.
_SIZES, _ABREAST, _BACK = (2, 2, 2, 3, 3, 4), 0.75, 0.15
#: Slowest walk, m/s, and factor of the speed with which somebody catches up with a group.
_SLOWEST, _HURRY = 0.5, 1.3
#: Positions tried for a start, and metres between people beyond their radii when they start.
_TRIES, _APART = 60, 0.1
#: Metres from a queue at which people walk back to its end.
_BESIDE = 1.0
#: Fastest walk, m/s; seconds in which a queue moves up by one, and in which somebody is next to the leader.
_FASTEST, _MOVE_UP, _CATCH_UP = 2.2, 2.5, 0.8
#: Radians by which people pass each other to the right; least factor of the speed in a curve.
_TO_THE_RIGHT, _CURVE = 0.04, 0.15
#: Number of times that people who would touch are moved apart; side of the square of a detour, metres.
_SEPARATIONS, _DETOUR = 4, 5.0
#: Side of the area of a crowd without a room, metres.
_OPEN = 10.0


def _human(crowd: CrowdConfig, name: str, home: Array, source: SceneSource) -> HumanConfig:
    """A person at the start (2,); the looks depend on the seed and the name only."""
    uniform = random_numbers(crowd.seed, name)
    bodies = crowd.bodies or built_in_names("humans")
    body = bodies[int(uniform() * len(bodies))]
    with in_section("crowd"):
        outfits = source.human(body, key="bodies").outfits
    motion = crowd.motions[int(uniform() * len(crowd.motions))]
    return HumanConfig(
        body=body,
        outfit=outfits[int(uniform() * len(outfits))],
        motion=MotionConfig(
            file=motion, loop="continue", position=(round(float(home[0]), 4), round(float(home[1]), 4))
        ),
        face=living_face(crowd.alive, crowd.seed),
    )


def _floor(draft: Draft, crowd: CrowdConfig) -> WalkGrid:
    """The floor with what stands on it: things, and the paths of all other humans."""
    area = _area(draft.config, crowd)
    covered = [things_on_floor(draft, area), *(each.points for each in footprints(draft).values())]
    return WalkGrid.of(area, np.concatenate(covered), crowd.radius)


def _area(config: SceneConfig, crowd: CrowdConfig) -> Array:
    """Low and high corner (2, 2) of the floor: as configured, within the room."""
    walls = floor_corners(config, _OPEN)
    if crowd.area is None:
        return walls
    corners = np.sort(np.reshape(crowd.area, (2, 2)), axis=0)
    if config.room is not None:
        corners = np.clip(corners, *walls)
    if (np.ptp(corners, axis=0) < 4 * crowd.radius).any():
        raise SceneError(
            "the area of the crowd has no floor: give two corners inside the room", key="crowd.area"
        )
    return corners


@dataclass
class _Person:
    """A person of the crowd while it is planned.

    Attributes:
        home: (2,) where it starts.
        speed: Speed of its walk alone, m/s.
        uniform: Its random numbers.
        goals: Corners (2, 2) of the areas that it walks to in turn.
        leader: Number of the person that it walks next to; None for its own goals.
        aside: Metres to the left of the leader.
        facing: Heading if it never walks, radians.
        way: Corners (2,) of its way, the last one its goal; empty while it stands.
        turn: Number of the next goal.
        until: Time at which it goes on, seconds.
        stays: Whether it keeps its place at the goal: at home, or in a queue.
        homewards: Whether it goes home.
        best: Shortest distance to the corner so far, and its time.
    """

    home: Array
    speed: float
    uniform: RandomNumbers
    goals: Sequence[Array] = ()
    leader: int | None = None
    aside: float = 0.0
    facing: float = 0.0
    way: list[Array] = field(default_factory=list)
    turn: int = 0
    until: float = 0.0
    stays: bool = False
    homewards: bool = False
    best: tuple[float, float] = (np.inf, 0.0)

    def go(self, way: list[Array], time: float, stays: bool = False) -> None:
        """Start to walk along ``way`` at ``time`` (seconds). ``stays``: keep the place at its end."""
        self.way, self.stays, self.best = way, stays, (np.inf, time)


@dataclass
class _Queue:
    """A line of people before a place where they are served.

    Attributes:
        places: (Q, 2), the first one first.
        way_back: (2, 2) corners of the way from the first place back to the last one.
        line: Numbers of the people in line.
        service: Seconds that one is served.
        services: How many are served in a round: in the end all are where they began.
        served: How many have been served.
        since: Time at which the first one came to its place.
    """

    places: Array
    way_back: Array
    line: list[int]
    service: float
    services: int
    served: int = 0
    since: float | None = None


class _Starts:
    """Places, speeds and goals at the start, from the seed."""

    def __init__(self, crowd: CrowdConfig, floor: WalkGrid) -> None:
        self._crowd, self._floor = crowd, floor
        self._names = variety_names(crowd.name, crowd.count)
        self._everywhere = floor.places()
        self._whole = [np.stack([floor.low, floor.high])]
        self._taken = np.zeros((0, 2))
        self._areas = [
            [self._area(f"crowd.flows.{number}.{end}", getattr(flow, end)) for end in ("start", "goal")]
            for number, flow in enumerate(crowd.flows)
        ]

    def _area(self, key: str, corners: Sequence[float]) -> Array:
        area = np.reshape(corners, (2, 2))
        if not len(self._floor.places(area)):
            text = "nobody can stand in this area: no free floor of the area of the crowd is within it"
            raise SceneError(text, key=key)
        return area

    def queue(self, number: int, people: list[_Person]) -> _Queue:
        """Add the people of a queue."""
        config, key = self._crowd.queues[number], f"crowd.queues.{number}"
        if len(people) + config.count > self._crowd.count:
            raise SceneError(
                f"the queues have more people than the crowd: {self._crowd.count}", key=f"{key}.count"
            )
        yaw = np.radians(config.direction_deg)
        back = np.array([np.cos(yaw), np.sin(yaw)])
        places = config.position + config.spacing * np.arange(config.count)[:, None] * back
        covered = np.flatnonzero(~(self._floor.free(places) & self._spaced(places)))
        if len(covered):
            raise SceneError(
                f"place {covered[0] + 1} of the queue is not free: move or turn the queue, or give it fewer "
                "people",
                key=f"{key}.position",
            )
        sides = [_BESIDE * np.array([-back[1], back[0]]), _BESIDE * np.array([back[1], -back[0]])]
        ways = [places[[0, -1]] + side for side in sides]
        way_back = max(ways, key=lambda ends: int(self._floor.free(ends).sum()))
        line = list(range(len(people), len(people) + config.count))
        for place in places:
            person = self._person(len(people), place)
            person.facing, person.stays = float(yaw + np.pi), True
            people.append(person)
        # the line is served until all are at their first place again
        slowest = min(people[one].speed for one in line)
        walk = (config.spacing * config.count + 2 * _BESIDE) / slowest * _HOMEWARDS + _STANDING
        rounds = (self._crowd.duration - walk) // (config.count * (config.service + _MOVE_UP))
        return _Queue(places, way_back, line, config.service, max(0, int(rounds)) * config.count)

    def group(self, people: list[_Person]) -> None:
        """Add a person, or people who walk together."""
        crowd, first = self._crowd, len(people)
        uniform = random_numbers(crowd.seed, f"group {self._names[first]}")
        mean = sum(_SIZES) / len(_SIZES)
        size = 1
        if uniform() < crowd.groups / (mean - crowd.groups * (mean - 1)):
            size = min(_SIZES[int(uniform() * len(_SIZES))], crowd.count - first)
        goals: Sequence[Array] = self._whole
        if self._areas:
            goals = self._areas[_weighted([flow.share for flow in crowd.flows], uniform())]
        turn = int(2 * uniform())
        leader = self._person(first, self._start(goals, uniform))
        members = [leader]
        for number in range(1, size):
            place = self._near(leader.home, uniform)
            members.append(self._person(first + number, place))
        speed = min(member.speed for member in members)
        for number, member in enumerate(members):
            member.goals, member.turn, member.speed = goals, turn, speed
            # the leader walks in the middle: the others to its left and right
            member.leader = first if number else None
            member.aside = (
                max(_ABREAST, 2 * crowd.radius + _APART) * ((number + 1) // 2) * (1 if number % 2 else -1)
            )
        people += members

    def _person(self, number: int, home: Array) -> _Person:
        self._taken = np.vstack([self._taken, home])
        uniform = random_numbers(self._crowd.seed, f"walk {self._names[number]}")
        mean, deviation = self._crowd.speed
        normal = np.sqrt(-2 * np.log(1 - uniform())) * np.cos(2 * np.pi * uniform())
        speed = float(np.clip(mean + deviation * normal, min(_SLOWEST, mean), _FASTEST))
        return _Person(home, speed, uniform)

    def _start(self, goals: Sequence[Array], uniform: RandomNumbers) -> Array:
        """A free place between the goals."""
        tries = []
        for _ in range(_TRIES):
            ends = [low + (high - low) * (uniform(), uniform()) for low, high in (goals[0], goals[-1])]
            tries.append(ends[0] + uniform() * (ends[1] - ends[0]) if len(goals) > 1 else ends[0])
        points = np.array(tries)
        free = np.flatnonzero(self._floor.free(points) & self._spaced(points))
        return points[free[0]] if len(free) else self._anywhere(uniform)

    def _near(self, point: Array, uniform: RandomNumbers) -> Array:
        """The free place nearest to a point."""
        free = self._everywhere[self._spaced(self._everywhere)]
        if not len(free):
            return self._anywhere(uniform)
        return np.asarray(free[((free - point) ** 2).sum(axis=1).argmin()])

    def _anywhere(self, uniform: RandomNumbers) -> Array:
        free = self._everywhere[self._spaced(self._everywhere)]
        if not len(free):
            raise SceneError(
                f"the area has room for {len(self._taken)} people, not for {self._crowd.count}: give fewer "
                "people, a larger area or room, or a smaller radius",
                key="crowd.count",
            )
        return np.asarray(free[int(uniform() * len(free))])

    def _spaced(self, points: Array) -> NDArray[np.bool_]:
        """Whether points (N, 2) are away from all places that are taken."""
        if not len(self._taken):
            return np.ones(len(points), bool)
        tree = scipy.spatial.cKDTree(self._taken)
        return np.asarray(tree.query(points)[0] >= 2 * self._crowd.radius + _APART)


def _weighted(weights: Sequence[float], share: float) -> int:
    """Index of one of the weights, for a random number from 0 to 1."""
    return min(int(np.searchsorted(np.cumsum(weights), share * sum(weights), side="right")), len(weights) - 1)


class _Plan:
    """The people on the floor, step by step.

    Attributes:
        people: The people in the order of their names.
        queues: Their queues.
        lost: Numbers of the people who are not back at the end.
        blocked: Numbers of the people who have no way to a goal.
    """

    def __init__(self, crowd: CrowdConfig, floor: WalkGrid) -> None:
        starts = _Starts(crowd, floor)
        self.people: list[_Person] = []
        self.queues = [starts.queue(number, self.people) for number in range(len(crowd.queues))]
        while len(self.people) < crowd.count:
            starts.group(self.people)
        self._in_line = np.zeros(len(self.people), bool)
        for queue in self.queues:
            self._in_line[queue.line] = True
        self._crowd, self._floor = crowd, floor
        self._at = np.array([person.home for person in self.people])
        self._velocities = np.zeros_like(self._at)
        self._headings = np.tile((1.0, 0.0), (len(self.people), 1))
        self._places: dict[int, Array] = {}
        self.lost: set[int] = set()
        self.blocked: set[int] = set()

    def run(self) -> Array:
        """Positions (K, N, 2) of all steps of a round, which ends when everybody is back."""
        count = round(self._crowd.duration / STEP)
        homes = np.array([person.home for person in self.people])
        out: list[Array] = []
        away = np.ones(len(homes), bool)
        while len(out) < count or (away.any() and len(out) < _LONGER * count):
            out.append(self._at.copy())
            self._step(len(out) * STEP)
            away = np.linalg.norm(self._at - homes, axis=1) > _ARRIVED
        self.lost = set(np.flatnonzero(away).tolist())
        return np.array(out)

    def _step(self, time: float) -> None:
        for queue in self.queues:
            self._move_up(queue, time)
        for number, person in enumerate(self.people):
            if not self._in_line[number]:
                self._choose(number, person, time)
        preferred = np.array([self._preferred(number, time) for number in range(len(self.people))])
        standing = ~preferred.any(axis=1)
        # people in line keep their places. Others step aside
        waiting = standing & self._in_line
        radius = np.full(len(self.people), self._crowd.radius)
        speeds = np.array([person.speed * _HURRY for person in self.people])
        walkers = Walkers(self._at, self._velocities, radius, speeds, waiting)
        obstacles = self._floor.obstacles(self._at)
        velocities = walkers.avoiding(self._turned(preferred), obstacles, self._floor.margin, _HORIZON, STEP)
        change = velocities - self._velocities
        size = np.linalg.norm(change, axis=1, keepdims=True)
        change *= np.minimum(1.0, _ACCELERATION * STEP / np.maximum(size, 1e-9))
        self._velocities = np.where(waiting[:, None], 0.0, self._velocities + change)
        self._move(waiting)

    def _move(self, waiting: NDArray[np.bool_]) -> None:
        """Move everybody; nobody gets into another person, a wall or a thing."""
        before, after = self._at, self._at + self._velocities * STEP
        apart = 2 * self._crowd.radius
        for _ in range(_SEPARATIONS):
            pairs = scipy.spatial.cKDTree(after).query_pairs(apart - 1e-6, output_type="ndarray")
            if not len(pairs):
                break
            a, b = pairs.T
            line = after[a] - after[b]
            distance = np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 1e-6)
            push = line / distance * (apart - distance)
            share = np.where(waiting[b], 1.0, 0.5) * ~waiting[a]
            np.add.at(after, a, share[:, None] * push)
            share = np.where(waiting[a], 1.0, 0.5) * ~waiting[b]
            np.add.at(after, b, -share[:, None] * push)
        blocked = ~self._floor.free(after) & self._floor.free(before)
        after[blocked] = before[blocked]
        self._velocities = (after - before) / STEP
        self._at = after
        fast = np.linalg.norm(self._velocities, axis=1) > _SLOWEST / 2
        walking = self._velocities[fast]
        self._headings[fast] = walking / np.linalg.norm(walking, axis=1)[:, None]

    def _turned(self, preferred: Array) -> Array:
        """Preferred velocities (N, 2) of people who turn in a curve, and pass on the right."""
        ahead = np.arctan2(self._headings[:, 1], self._headings[:, 0])
        wish = np.arctan2(preferred[:, 1], preferred[:, 0])
        turn = np.mod(wish - ahead + np.pi, 2 * np.pi) - np.pi
        walking = np.linalg.norm(self._velocities, axis=1) > _SLOWEST / 2
        limit = np.where(walking, _TURN * STEP, np.pi)
        angle = ahead + np.clip(turn, -limit, limit) - _TO_THE_RIGHT
        # the sharper the turn the slower: nobody circles around a goal
        slower = np.where(np.abs(turn) > limit, np.clip(np.cos(turn), _CURVE, 1.0), 1.0)
        speed = slower * np.linalg.norm(preferred, axis=1)
        return speed[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def _move_up(self, queue: _Queue, time: float) -> None:
        """Let the people of a queue move up, and the first one go when it is served."""
        first = queue.line[0]
        if queue.served < queue.services and not self.people[first].way:
            queue.since = time if queue.since is None else queue.since
            if time - queue.since >= queue.service:
                queue.line.append(queue.line.pop(0))
                self.people[first].go([*queue.way_back, queue.places[-1]], time, stays=True)
                queue.served, queue.since = queue.served + 1, None
        for number, place in zip(queue.line, queue.places, strict=True):
            person = self.people[number]
            if person.way:
                person.way[-1] = place
            elif math.hypot(*(self._at[number] - place)) > _ARRIVED:
                person.go([place], time, stays=True)

    def _choose(self, number: int, person: _Person, time: float) -> None:
        """Give a person a new goal if it needs one."""
        if person.homewards:
            if not person.way and math.hypot(*(self._at[number] - person.home)) > _ARRIVED:
                person.go([person.home], time, stays=True)
            return
        chief = person if person.leader is None else self.people[person.leader]
        left = self._crowd.duration - time - _STANDING
        needed = _HOMEWARDS * math.hypot(*(person.home - self._at[number])) / person.speed
        if chief.homewards or left < needed:
            person.homewards = True
            person.go(self._way(number, person.home) or [person.home], time, stays=True)
        elif person.leader is None and not person.way and time >= person.until:
            person.turn += 1
            way = self._way(number, self._goal(person))
            if way is None:
                self.blocked.add(number)
                person.until = time + _PATIENCE
            person.go(way or [], time)

    def _goal(self, person: _Person) -> Array:
        """A place (2,) at random in the next area of a person."""
        area = person.goals[person.turn % len(person.goals)]
        if id(area) not in self._places:
            self._places[id(area)] = self._floor.places(area)
        places = self._places[id(area)]
        return np.asarray(places[int(person.uniform() * len(places))])

    def _way(self, number: int, goal: Array) -> list[Array] | None:
        return self._floor.way(self._at[number], goal)

    def _preferred(self, number: int, time: float) -> Array:
        """Velocity (2,) that a person would have alone; 0 for who stands."""
        person, at = self.people[number], self._at[number]
        if person.leader is not None and not person.homewards:
            return self._beside(person, at)
        if not person.way:
            return np.zeros(2)
        while len(person.way) > 1 and self._has_passed(at, person.way):
            person.way.pop(0)
            person.best = (np.inf, time)
        line = person.way[0] - at
        distance = math.hypot(*line)
        if len(person.way) == 1 and distance < (_ARRIVED if person.stays else _PASSED):
            if person.stays:
                self._at[number] = person.way[0]
            person.way = []
            low, high = self._crowd.pause
            person.until = time + low + (high - low) * person.uniform()
            return np.zeros(2)
        if distance < person.best[0] - _PROGRESS:
            person.best = distance, time
        elif time - person.best[1] > _PATIENCE:
            self._give_up(number, person, time)
        arrives = person.stays and len(person.way) == 1
        speed = min(person.speed, distance / (2 * STEP)) if arrives else person.speed
        return speed * line / max(distance, 1e-9)

    def _has_passed(self, at: Array, way: list[Array]) -> bool:
        """Whether somebody is at a corner, or sees the next one."""
        return bool(math.hypot(*(way[0] - at)) < _PASSED or self._floor.sees(at[None], way[1][None])[0])

    def _give_up(self, number: int, person: _Person, time: float) -> None:
        """Give a person who gets nowhere another goal, or a detour if the person must get there."""
        person.best = (np.inf, time)
        if not person.stays:
            person.way = []
            return
        around = self._at[number] + _DETOUR * (np.array([person.uniform(), person.uniform()]) - 0.5)
        if self._floor.free(around) and self._floor.sees(self._at[number][None], around[None])[0]:
            person.way = [around, *(self._floor.way(around, person.way[-1]) or [person.way[-1]])]

    def _beside(self, person: _Person, at: Array) -> Array:
        """Velocity (2,) of somebody who walks next to the leader, behind where there is no room."""
        assert person.leader is not None
        chief, ahead = self._at[person.leader], self._headings[person.leader]
        left = np.array([-ahead[1], ahead[0]])
        place = chief + person.aside * left - _BACK * abs(person.aside) * ahead
        if not self._floor.free(place):
            place = chief - abs(person.aside) * ahead
        velocity = self._velocities[person.leader]
        gap = place - at
        if not velocity.any() and math.hypot(*gap) < _PASSED:
            return np.zeros(2)
        if not self._floor.sees(at[None], place[None])[0]:
            gap = (self._floor.way(at, chief) or [chief])[0] - at
        wish = velocity + gap / _CATCH_UP
        return np.asarray(wish * min(1.0, _HURRY * person.speed / max(math.hypot(*wish), 1e-9)))


class Crowd(Feature):
    """The section ``crowd``."""

    def expand(self, draft: Draft) -> None:
        """Add the people of the crowd with their paths. A HumansimWarning names the people who get nowhere.
        Raises SceneError if the people have no room, or a goal has no floor. The error names the key."""
        crowd, source = draft.config.crowd, draft.source
        if crowd is None or not crowd.count:
            return
        names = variety_names(crowd.name, crowd.count)
        plan = _Plan(crowd, _floor(draft, crowd))
        points = plan.run()
        humans = {
            name: _human(crowd, name, person.home, source)
            for name, person in zip(names, plan.people, strict=True)
        }
        for number, queue in enumerate(plan.queues):
            if not queue.services:
                source.warn(
                    f"crowd.queues.{number}",
                    "nobody is served: a round is too short for all to be at the first place. Give a "
                    "longer round (crowd.duration), fewer people, or a shorter service",
                )
        jump = (
            "not back at the start at the end of a round, and a jump there: give fewer people (count), "
            "a larger area, or a longer round (duration)"
        )
        no_way = "no way to a goal, as walls or things are between: they walk to other goals only"
        for numbers, problem in ((plan.blocked, no_way), (plan.lost, jump)):
            if numbers:
                source.warn("crowd", f"{some_of(names[number] for number in sorted(numbers))}: {problem}")
        draft.config = draft.config.model_copy(update={"humans": draft.config.humans | humans})
        for name, person, line in zip(names, plan.people, np.moveaxis(points, 1, 0), strict=True):
            try:
                draft.add_human(name, humans[name], WalkPath(line, STEP, person.facing))
            except HumansimError as error:
                raise type(error)(error.message, key="crowd.motions") from error.__cause__


FEATURE = Crowd()
