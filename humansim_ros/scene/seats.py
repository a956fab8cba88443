"""Seats: where people sit, what is below them there, and the chairs and tables that are put there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from humansim_ros.geometry import segments_crossing
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.motion.activity import needs_table
from humansim_ros.motion.path_motion import PathMotion
from humansim_ros.motion.soles import true_runs
from humansim_ros.scene.actor import Actor
from humansim_ros.scene.config import LIVE, MotionConfig, ObjectConfig, SceneConfig
from humansim_ros.scene.objects import SceneObject
from humansim_ros.scene.room import furniture_tops
from humansim_ros.scene.source import SceneSource
from humansim_ros.types import Array

#: Masses of trunk with head and arms, of both thighs, and of both shins with feet [Winter 2009, table 4.1].
_MASSES = (0.678, 0.200, 0.122)
#: A person sits if the hips are between these shares of the length of the legs above the ankles, and the
#: center of mass is behind the ankles by more than this share: nobody stands so. Children who lift something
#: from the floor reach 0.16, people on seats are above 0.30.
_LOW, _HIGH, _BEHIND = 0.25, 0.75, 0.22
#: Hips that sit are slower than this, m/s, for at least these seconds.
_STILL, _SHORTEST = 0.15, 0.5
#: Seconds between two times, and most seconds, in which people are watched.
_STEP, _WATCHED = 0.1, 120.0
#: Places of one seat are nearer than this, metres.
_SAME = 0.2
#: Height of the hips of the built-in sitting motions over a seat, metres, and the height of that seat.
_FLESH, _SEAT = 0.09, 0.45
#: Distances below the hips, metres, in which something is a seat.
_BELOW = (0.02, 0.28)
#: Metres from the hips to the middle of a table in front, of a person of the size of the default human.
_TO_TABLE = 0.68
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
    """Places where a person sits, each once.

    Args:
        joints: Joints (N, J, 3) in ``map`` at evenly spaced times.
        names: Names of the joints.
        times: Seconds (N,).
    """
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
    low = (height > _LOW * length) & (height < _HIGH * length)
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


def is_above(point: Array, meshes: Sequence[Mesh]) -> bool:
    """Whether a surface is below hips, from 0.02 to 0.28 m.

    Args:
        point: Middle of the hips, (3,) in the axes of the meshes.
        meshes: Things that somebody may sit on.
    """
    start, end = (point[None] - (0.0, 0.0, below) for below in _BELOW)
    corners = (np.asarray(mesh.vertices, dtype=float)[mesh.triangles] for mesh in meshes)
    return any(segments_crossing(start, end, each)[0] for each in corners)


@dataclass(frozen=True)
class Seats:
    """What people may sit on.

    Attributes:
        config: The scene.
        objects: Objects of the scene.
        meshes: Static meshes of the world in ``map``.
    """

    config: SceneConfig
    objects: Mapping[str, SceneObject]
    meshes: Sequence[Mesh]

    def below(self, sitting: Sitting) -> bool:
        """Whether something is below a person who sits: an object, a mesh, or furniture of the room."""
        static = [item.static_mesh() for item in self.objects.values() if not item.moves]
        if is_above(sitting.hips, [*self.meshes, *static]):
            return True
        for item in self.objects.values():
            if item.moves:
                point = item.to_mesh(sitting.hips[None, None], np.array([sitting.time]))[0, 0]
                if is_above(point * item.initial_pose.size, [_sized(item)]):
                    return True
        if self.config.room is None:
            return False
        for (x, y), (width, depth), top in furniture_tops(self.config.room.size[:2]).values():
            apart = np.abs(sitting.hips[:2] - (x, y))
            if (apart < (width / 2, depth / 2)).all() and _BELOW[0] < sitting.hips[2] - top < _BELOW[1]:
                return True
        return False


def _sized(item: SceneObject) -> Mesh:
    """Mesh of an object in metres about its own origin."""
    return Mesh(item.mesh.vertices * item.initial_pose.size, item.mesh.faces)


def sittings_of(actor: Actor, source: SceneSource, config: MotionConfig) -> list[Sitting]:
    """Places where a human of a scene sits; none for people of a crowd, and for those whom a node moves."""
    if isinstance(actor.motion, PathMotion) or config.file == LIVE:
        return []
    length = actor.motion.duration if actor.motion.loop != "continue" and actor.keyframes is None else 60.0
    if not np.isfinite(length) or length <= 0:
        length = 1.0
    count = 2 + int(min(length, _WATCHED) / _STEP)
    times = np.linspace(0.0, min(length, _WATCHED), count)
    if not source.once(lambda: _bends(actor, times), "sits", config.file, config.start, config.end):
        return []
    return find_sittings(actor.joint_paths(times), actor.human.skeleton.joint_names, times)


def _bends(actor: Actor, times: Array) -> bool:
    """Whether the hips of a motion are low at any time: whoever's hips are not low does not sit."""
    roles = actor.motion.match.roles
    ankles = [roles.get(f"{side}Ankle", roles[f"{side}Knee"]) for side in ("Left", "Right")]
    positions = actor.motion.sample(times, actor.ahead).positions
    height = positions[:, roles["Hips"], 2] - positions[:, ankles, 2].mean(axis=1)
    return bool(height.min() < _HIGH * 1.15 * actor.motion.frame.ankle_to_head * actor.motion.frame.unit / 2)


def furniture_for(
    actors: Mapping[str, Actor], seats: Seats, source: SceneSource
) -> Iterator[tuple[str, ObjectConfig]]:
    """Chairs and tables, with names, for those who sit where nothing is below them.

    The chair is as high as the person sits. Somebody who writes or eats gets a table in front.
    """
    for name, actor in actors.items():
        human = seats.config.humans[name]
        if human.seat == "none":
            continue
        number = 0
        for sitting in sittings_of(actor, source, human.motion):
            if seats.below(sitting):
                continue
            number += 1
            suffix = "" if number == 1 else f"_{number}"
            factor = max(sitting.height, 0.1) / _SEAT
            yield _free(f"{name}_chair{suffix}", seats.objects), _at(sitting, "chair", 0.0, factor)
            if needs_table(human.motion.file):
                yield _free(f"{name}_table{suffix}", seats.objects), _at(sitting, "table", _TO_TABLE, factor)


def seat_footprint(sitting: Sitting, table: bool) -> Array:
    """Points (M, 2) 5 cm apart on the floor below the chair of a person who sits, and below the table."""
    boxes = [(0.0, 0.44, 0.43), *([(_TO_TABLE * sitting.size, 0.8, 1.6)] if table else [])]
    points = []
    for ahead, depth, width in boxes:
        x, y = (np.arange(-side / 2, side / 2 + 0.05, 0.05) for side in (depth, width))
        points.append(np.stack(np.meshgrid(x + ahead, y), axis=-1).reshape(-1, 2))
    c, s = np.cos(sitting.yaw), np.sin(sitting.yaw)
    return np.asarray(np.concatenate(points) @ np.array([[c, s], [-s, c]]) + sitting.hips[:2])


#: Half of the distance between the two places of a sofa, and hips behind its front edge, metres.
_SOFA_PLACES, _SOFA_DEPTH = 0.5, 0.375
#: A seat fits who sits if it is lower, or higher, than this by less, metres: cushions give way by little.
_LOWER, _HIGHER = 0.07, 0.045


@dataclass(frozen=True)
class Seat:
    """A place of a chair of the scene, or of the sofa of the room.

    Attributes:
        place: Middle of the hips of a person of the size of the default human who sits there, (2,) metres in
            ``map``.
        yaw: Heading of who sits there, radians.
        height: Height of the seat, metres.
        middle: Middle of the chair or sofa, (2,).
        size: Its sides along the heading and across, (2,) metres.
        depth: Metres from there to the front edge, at which knees bend; 0 where the seat is shallow.
    """

    place: Array
    yaw: float
    height: float
    middle: Array
    size: Array
    depth: float = 0.0

    def place_of(self, sitting: Sitting) -> Array:
        """Middle of the hips (2,) of a person: smaller people sit nearer to the edge."""
        ahead = self.depth * (1 - sitting.size)
        return self.place + ahead * np.array([np.cos(self.yaw), np.sin(self.yaw)])

    def covers(self, points: Array, margin: float = 0.05) -> NDArray[np.bool_]:
        """Whether points (N, 2) are above the chair or sofa, or beside it by a margin in metres."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        own = (points - self.middle) @ np.array([[c, -s], [s, c]])
        return np.asarray((np.abs(own) < self.size / 2 + margin).all(axis=1))

    def fits(self, sitting: Sitting) -> bool:
        """Whether its height is right for a person who sits."""
        return -_LOWER < self.height - sitting.height < _HIGHER


def seats_of(config: SceneConfig) -> list[Seat]:
    """Chairs that stand on the floor of a scene, and both places of the sofa of its room."""
    found = []
    for item in config.objects.values():
        level = item.rotation_deg[:2] == (0.0, 0.0) and abs(item.position[2]) < 0.02
        if item.mesh == "chair" and level and item.keyframes is None and item.held_by is None:
            middle, size = np.array(item.position[:2]), np.array(item.size[:2]) * (0.44, 0.43)
            height = item.position[2] + _SEAT * item.size[2]
            found.append(Seat(middle, float(np.radians(item.rotation_deg[2])), height, middle, size))
    if config.room is not None:
        (x, y), (depth, width), top = furniture_tops(config.room.size[:2])["sofa"]
        middle, hips = np.array([x, y]), x + depth / 2 - _SOFA_DEPTH
        found += [
            Seat(np.array([hips, y + side]), 0.0, top, middle, np.array([depth, width]), _SOFA_DEPTH)
            for side in (-_SOFA_PLACES, _SOFA_PLACES)
        ]
    return found


def _free(name: str, taken: Mapping[str, object]) -> str:
    while name in taken:
        name += "_"
    return name


def _at(sitting: Sitting, mesh: str, ahead: float, factor: float) -> ObjectConfig:
    """Furniture in front of the hips by some metres, with another height."""
    way = np.array([np.cos(sitting.yaw), np.sin(sitting.yaw)])
    x, y = np.round(sitting.hips[:2] + ahead * sitting.size * way, 4).tolist()
    yaw = round(float(np.degrees(sitting.yaw)), 2)
    return ObjectConfig(
        mesh=mesh, size=(1.0, 1.0, round(factor, 4)), position=(x, y, 0.0), rotation_deg=(0.0, 0.0, yaw)
    )
