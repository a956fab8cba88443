"""Anatomical angles of a joint, from its rotation and back, and their clamping to the limits.

Hinges and the spine have three axes, one after the other [Grood 1983]: one of the bone above, a floating one,
one of the bone itself. Shoulders and hips have a direction of the bone, within a cone [Wilhelms 2001], and a
twist about it that counts from the shortest rotation out of the middle of the cone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from humansim_ros.motion.limit_table import JointRange, Limit, direction_vector
from humansim_ros.rotations import from_y_axis, quaternion_to_matrix
from humansim_ros.types import Array


@dataclass(frozen=True)
class JointAngles:
    """Coordinates (N, 3) of a joint, degrees; ``offset`` (N,) is the share of another joint in the third."""

    values: Array
    offset: Array


@dataclass(frozen=True)
class JointCoordinates(ABC):
    """Coordinates of a joint of a skeleton.

    ``bone``: index of its bone. ``chain``: bones between that bone and the bone of reference. ``before``,
    ``after``: (3, 3) rotations that take the rotation of the joint into anatomical axes.
    """

    range: JointRange
    side: int
    margin: float
    bone: int
    chain: tuple[int, ...]
    before: Array
    after: Array

    def measure(self, rotations: Array, offset: Array) -> JointAngles:
        """Coordinates of the joint in bone rotations (N, B, 3, 3)."""
        values = self.split(self.before @ self._inherited(rotations) @ rotations[:, self.bone] @ self.after)
        values[:, 2] = np.where(offset == 0, values[:, 2], values[:, 2] + offset)
        return JointAngles(values, offset)

    def bone_rotation(self, relative: Array, rotations: Array) -> Array:
        """Rotation (N, 3, 3) of the bone itself, from that of the joint in anatomical axes (N, 3, 3)."""
        inherited = np.swapaxes(self._inherited(rotations), -1, -2)
        return np.asarray(inherited @ self.before.T @ relative @ self.after.T)

    def _inherited(self, rotations: Array) -> Array:
        product = np.broadcast_to(np.eye(3), (len(rotations), 3, 3))
        for bone in self.chain:
            product = product @ rotations[:, bone]
        return product

    def bounds(self, pair: Sequence[Limit]) -> tuple[float, float]:
        """Lowest and highest value of a pair of opposite limits."""
        return -pair[1].degrees - self.margin, pair[0].degrees + self.margin

    def pair_against_limits(self, pair: Sequence[Limit], values: Array) -> Iterator[tuple[str, float, Array]]:
        """(angle, limit, values (N,)) of both limits of a pair."""
        for row, signed in zip(pair, (values, -values), strict=True):
            yield row.angle, row.degrees + self.margin, signed

    @abstractmethod
    def split(self, relative: Array) -> Array:
        """Coordinates (N, 3) of rotations (N, 3, 3) in anatomical axes."""

    @abstractmethod
    def compose(self, values: Array, offset: Array) -> Array:
        """Rotations (N, 3, 3) in anatomical axes that :meth:`measure` gives these coordinates for."""

    @abstractmethod
    def clamp(self, measured: JointAngles) -> Array:
        """Coordinates (N, 3) within the limits."""

    @abstractmethod
    def named_angles(self, measured: JointAngles) -> dict[str, Array]:
        """Angle -> values (N,), degrees."""

    @abstractmethod
    def against_limits(self, measured: JointAngles) -> Iterator[tuple[str, float, Array]]:
        """(angle, limit, values (N,)) of each limit."""


class HingeCoordinates(JointCoordinates):
    """Rotations about three axes, one after the other."""

    @cached_property
    def pairs(self) -> tuple[tuple[Limit, Limit], ...]:
        """Opposite limits about each axis."""
        assert self.range.first is not None and self.range.second is not None
        return (self.range.first, self.range.second, self.range.twist)

    @cached_property
    def axes(self) -> tuple[Array, float]:
        """Right-handed axes as columns (3, 3), and the sign of the third axis in them."""
        first, second, third = (pair[0].axis(self.side) for pair in self.pairs)
        right_handed = np.cross(first, second)
        return np.stack([first, second, right_handed], axis=-1), float(right_handed @ third)

    def split(self, relative: Array) -> Array:
        axes, sign = self.axes
        m = axes.T @ relative @ axes
        first = np.arctan2(-m[:, 1, 2], m[:, 2, 2])
        second = np.arctan2(m[:, 0, 2], np.hypot(m[:, 1, 2], m[:, 2, 2]))
        third = sign * np.arctan2(-m[:, 0, 1], m[:, 0, 0])
        return np.degrees(np.stack([first, second, third], axis=-1))

    def compose(self, values: Array, offset: Array) -> Array:
        axes, sign = self.axes
        angles = np.radians(values - np.stack([0 * offset, 0 * offset, offset], axis=-1)) * [1.0, 1.0, sign]
        rotations = [_about_axis(axes[:, i], angles[:, i]) for i in range(3)]
        return np.asarray(rotations[0] @ rotations[1] @ rotations[2])

    def clamp(self, measured: JointAngles) -> Array:
        return np.clip(measured.values, *np.array([self.bounds(pair) for pair in self.pairs]).T)

    def named_angles(self, measured: JointAngles) -> dict[str, Array]:
        return {pair[0].angle: measured.values[:, i] for i, pair in enumerate(self.pairs)}

    def against_limits(self, measured: JointAngles) -> Iterator[tuple[str, float, Array]]:
        for i, pair in enumerate(self.pairs):
            yield from self.pair_against_limits(pair, measured.values[:, i])


class ConeCoordinates(JointCoordinates):
    """Distance of the bone from the middle of the cone, azimuth about it, and twist."""

    @cached_property
    def middle(self) -> Array:
        """Direction (3,) of the middle of the cone."""
        assert self.range.along is not None
        return direction_vector(self.range.along, self.side)

    @cached_property
    def azimuth_axes(self) -> tuple[Array, Array]:
        """Directions (3,) perpendicular to the middle, with azimuth 0 and 90 degrees."""
        first = self.range.twist[0]
        return direction_vector(first.start, self.side), direction_vector(first.towards, self.side)

    @cached_property
    def border(self) -> tuple[Array, Array]:
        """Azimuths and distances (P,) of the limits of the swing with the margin, degrees."""
        assert self.range.swing is not None
        return self._polar(np.stack([row.end_direction(self.side, self.margin) for row in self.range.swing]))

    def _polar(self, directions: Array) -> tuple[Array, Array]:
        """Azimuth and distance (N,) of directions (N, 3), degrees."""
        u, v = self.azimuth_axes
        across = np.stack([directions @ u, directions @ v])
        distance = np.arctan2(np.hypot(*across), directions @ self.middle)
        return np.degrees(np.arctan2(across[1], across[0])), np.degrees(distance)

    def _direction(self, azimuth: Array, distance: Array) -> Array:
        """Directions (N, 3) at azimuths and distances (N,), degrees."""
        u, v = self.azimuth_axes
        azimuth, distance = np.radians(azimuth)[:, None], np.radians(distance)[:, None]
        return np.asarray(
            np.cos(distance) * self.middle + np.sin(distance) * (np.cos(azimuth) * u + np.sin(azimuth) * v)
        )

    def _border_distance(self, azimuth: Array) -> Array:
        """Distance (N,) of the border at azimuths (N,), degrees."""
        azimuths, distances = self.border
        return np.asarray(np.interp(azimuth, azimuths, distances, period=360.0))

    def split(self, relative: Array) -> Array:
        azimuth, distance = self._polar(relative @ self.middle)
        # from azimuth and distance, not from the direction itself, so that compose() is the exact inverse
        swing = shortest_rotations(self.middle, self._direction(azimuth, distance))
        u, v = self.azimuth_axes
        across = np.swapaxes(swing, -1, -2) @ relative @ u
        return np.stack([distance, azimuth, np.degrees(np.arctan2(across @ v, across @ u))], axis=-1)

    def compose(self, values: Array, offset: Array) -> Array:
        swing = shortest_rotations(self.middle, self._direction(values[:, 1], values[:, 0]))
        axis = np.asarray(np.cross(*self.azimuth_axes), dtype=float)
        return np.asarray(swing @ _about_axis(axis, np.radians(values[:, 2] - offset)))

    def clamp(self, measured: JointAngles) -> Array:
        distance, azimuth, twist = measured.values.T
        clamped = np.minimum(distance, self._border_distance(azimuth))
        return np.stack([clamped, azimuth, np.clip(twist, *self.bounds(self.range.twist))], axis=-1)

    def named_angles(self, measured: JointAngles) -> dict[str, Array]:
        assert self.range.zero is not None
        direction = self._direction(measured.values[:, 1], measured.values[:, 0])
        zero = direction_vector(self.range.zero.direction, self.side)
        towards = {
            name: direction @ direction_vector(to, self.side) for name, to in self.range.zero.angles.items()
        }
        across = direction - (direction @ zero)[:, None] * zero
        length = np.linalg.norm(across, axis=-1)
        angle = np.degrees(np.arctan2(length, direction @ zero)) / np.maximum(length, 1e-12)
        return {name: share * angle for name, share in towards.items()} | {
            self.range.twist[0].angle: measured.values[:, 2]
        }

    def against_limits(self, measured: JointAngles) -> Iterator[tuple[str, float, Array]]:
        assert self.range.swing is not None
        distance, azimuth, twist = measured.values.T
        beyond = distance - self._border_distance(azimuth)
        to_named = np.abs((azimuth[:, None] - self.border[0] + 180) % 360 - 180)
        nearest = np.argmin(to_named, axis=-1)
        for i, row in enumerate(self.range.swing):
            limit = row.degrees + self.margin
            yield row.angle, limit, np.where(nearest == i, limit + beyond, -np.inf)
        yield from self.pair_against_limits(self.range.twist, twist)


def shortest_rotations(start: Array, ends: Array) -> Array:
    """Shortest rotations (..., 3, 3) of a unit vector (3,) along an axis onto others (..., 3)."""
    second = np.roll(start, 1)
    axes = np.stack([second, start, np.cross(second, start)], axis=-1)
    return np.asarray(axes @ quaternion_to_matrix(from_y_axis(ends @ axes)) @ axes.T)


def _about_axis(axis: Array, angles: NDArray[np.floating]) -> Array:
    """Rotations (N, 3, 3) about a unit vector (3,) by radians (N,)."""
    half = angles[:, None] / 2
    return quaternion_to_matrix(np.concatenate([np.sin(half) * axis, np.cos(half)], axis=-1))
