"""Places where people sit: of their motions, and of the chairs and the room of a scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from humansim_ros.motion.pose import true_runs
from humansim_ros.scene.config.config import SceneConfig
from humansim_ros.scene.core.environment import Fixture
from humansim_ros.types import Array

#: Masses of trunk with head and arms, of both thighs, and of both shins with feet [Winter 2009, table 4.1].
_MASSES = (0.678, 0.200, 0.122)
#: A person sits if the hips are between these shares of the length of the legs above the ankles, and the
#: center of mass is behind the ankles by more than this share: nobody stands so. Children who lift something
#: from the floor reach 0.16, people on seats are above 0.30.
_LOW, HIGHEST_HIPS, _BEHIND = 0.25, 0.75, 0.22
#: Hips that sit are slower than this, m/s, for at least these seconds.
_STILL, _SHORTEST = 0.15, 0.5
#: Places of one seat are nearer than this, metres.
_SAME = 0.2
#: Height of the hips of the built-in sitting motions over a seat, metres, and the height of that seat.
_FLESH, SEAT_HEIGHT = 0.09, 0.45
#: Metres from the hips to the middle of a table in front, of a person of the size of the default human.
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
    low = (height > _LOW * length) & (height < HIGHEST_HIPS * length)
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
        """Whether points (N, 2) are above the chair or sofa, or next to it by a margin in metres."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        own = (points - self.middle) @ np.array([[c, -s], [s, c]])
        return np.asarray((np.abs(own) < self.size / 2 + margin).all(axis=1))

    def fits(self, sitting: Sitting) -> bool:
        """Whether its height is right for a person who sits."""
        return -_LOWER < self.height - sitting.height < _HIGHER


def seats_of(config: SceneConfig, fixtures: Mapping[str, Fixture]) -> list[Seat]:
    """Chairs that stand on the floor of a scene, and both places of the sofa of its room.

    ``fixtures``: furniture of the room by name.
    """
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
        found += [
            Seat(np.array([hips, y + side]), 0.0, top, middle, np.array([depth, width]), _SOFA_DEPTH)
            for side in (-_SOFA_PLACES, _SOFA_PLACES)
        ]
    return found
