"""Joint limits of a skeleton: measure poses with a table of ranges, report violations, and clamp.

Angles are anatomical (docs/limits.md). They do not depend on the rest pose of the skeleton or on the rolls of
its bones. Only the angles of fingers and toes are measured from the axes of their bones at rest. Hinges and
the spine rotate about three axes, one after the other [Grood 1983]. The direction of shoulders and hips must
be within a cone [Wilhelms 2001].
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, model_validator

from humansim_ros.errors import MotionError, unknown
from humansim_ros.files.reading import resource_path
from humansim_ros.files.yaml import Section, read_yaml, validated
from humansim_ros.geometry import from_y_axis, matrix_to_quaternion, quaternion_to_matrix
from humansim_ros.motion.body.skeleton import DETAIL_BONES, Skeleton, hanim_skeleton, side_of
from humansim_ros.types import Array

#: Anatomical directions. ``out`` is away from the middle of the body, so that both sides can share a range.
AnatomicalDirection = Literal["up", "down", "front", "back", "left", "right", "out", "in"]
#: Directions in body space: +x is the left of the person, y is up, +z is the front.
_DIRECTIONS: dict[str, tuple[float, float, float]] = {
    "up": (0.0, 1.0, 0.0),
    "down": (0.0, -1.0, 0.0),
    "front": (0.0, 0.0, 1.0),
    "back": (0.0, 0.0, -1.0),
    "left": (1.0, 0.0, 0.0),
    "right": (-1.0, 0.0, 0.0),
}


def direction_vector(name: AnatomicalDirection, side: int) -> Array:
    """Unit vector (3,) of an anatomical direction, on the left (1) or right (-1) side."""
    if name in ("out", "in"):
        return np.array([float(side) if name == "out" else -float(side), 0.0, 0.0])
    return np.array(_DIRECTIONS[name])


class Limit(Section):
    """One end of a range: direction ``from`` (``start``) rotates ``towards`` another by at most ``degrees``.

    ``source``: key of the source.
    """

    model_config = ConfigDict(populate_by_name=True)

    angle: str
    start: AnatomicalDirection = Field(alias="from")
    towards: AnatomicalDirection
    degrees: float = Field(ge=0, le=180)
    source: str

    def axis(self, side: int) -> Array:
        """Rotation axis (3,) on the left (1) or right (-1) side."""
        axis = np.cross(direction_vector(self.start, side), direction_vector(self.towards, side))
        return np.asarray(axis, dtype=float)

    def end_direction(self, side: int, margin: float = 0.0) -> Array:
        """Direction ``from`` (3,) rotated to the limit and ``margin`` degrees beyond."""
        angle = np.radians(self.degrees + margin)
        start, towards = direction_vector(self.start, side), direction_vector(self.towards, side)
        return np.asarray(np.cos(angle) * start + np.sin(angle) * towards)


@lru_cache(maxsize=1)
def _bones() -> tuple[str, ...]:
    """Names of the bones that can have limits."""
    return (*hanim_skeleton().names, *DETAIL_BONES)


class ZeroDirection(Section):
    """Zero of the angles of a cone: degrees count from ``direction`` towards the direction of each angle."""

    direction: AnatomicalDirection
    angles: Mapping[str, AnatomicalDirection]


class JointRange(Section):
    """Ranges of ``bone`` (of both sides, for bones of the limbs) ``relative_to`` a bone above it.

    ``along``: direction of the bone at zero; without it the zero is the rest pose. Either ``swing``,
    directions on the border of a cone, with ``zero``; or ``first`` and ``second``, ranges about the axes
    before the ``twist``. ``twist_with``: bone with a twist that is added. ``hinge``: the first axis is the x
    axis of the bone, ``from`` of its first limit is along the bone, and other angles are zero at rest.
    """

    bone: str
    relative_to: str
    along: AnatomicalDirection | None = None
    zero: ZeroDirection | None = None
    swing: tuple[Limit, ...] | None = None
    first: tuple[Limit, Limit] | None = None
    second: tuple[Limit, Limit] | None = None
    twist: tuple[Limit, Limit]
    twist_with: str | None = None
    hinge: bool = False

    @property
    def rows(self) -> tuple[Limit, ...]:
        """All limits."""
        return (*(self.swing or ()), *(self.first or ()), *(self.second or ()), *self.twist)

    @property
    def sides(self) -> dict[str, int]:
        """Names of the bones that have these ranges, each with its side: 1 left, -1 right, 0 neither."""
        sides = {name: side_of(name) for name in (self.bone, f"l_{self.bone}", f"r_{self.bone}")}
        return {name: side for name, side in sides.items() if name in _bones()}

    @model_validator(mode="after")
    def _check_geometry(self) -> JointRange:
        if not self.sides:
            raise ValueError(unknown("bone", self.bone, _bones(), most=80))
        allowed = {"up", "down", "front", "back"}
        allowed |= {"out", "in"} if any(self.sides.values()) else {"left", "right"}
        used = {direction for row in self.rows for direction in (row.start, row.towards)}
        used |= {self.along} if self.along else set()
        used |= {self.zero.direction, *self.zero.angles.values()} if self.zero else set()
        if not used <= allowed:
            raise ValueError(f"directions of {self.bone} are {', '.join(sorted(allowed))}")
        for row in self.rows:
            if not row.axis(1).any():
                raise ValueError(f"{row.angle}: nothing turns from {row.start} towards {row.towards}")
        if self.hinge and self.first is None:
            raise ValueError("'hinge' needs 'first' and 'second'")
        if (self.swing is None) == (self.first is None) or (self.first is None) != (self.second is None):
            raise ValueError("give either 'swing' or both 'first' and 'second'")
        pairs = [pair for pair in (self.first, self.second, self.twist) if pair is not None]
        for one, other in pairs:
            if not np.allclose(one.axis(1), -other.axis(1)):
                raise ValueError(f"{one.angle} and {other.angle} are not opposite turns about one axis")
        axes = np.array([pair[0].axis(1) for pair in pairs])
        if not np.allclose(axes @ axes.T, np.eye(len(axes))):
            raise ValueError("its axes are not at right angles")
        if self.swing is not None:
            if self.along is None or self.zero is None or len(self.swing) < 3:
                raise ValueError("'swing' needs 'along', 'zero' and three directions or more")
            along = direction_vector(self.along, 1)
            if not np.allclose(np.abs(axes[0]), np.abs(along)):
                raise ValueError(f"{self.twist[0].angle} is no twist about {self.along}")
            for row in self.swing:
                if not np.linalg.norm(np.cross(along, row.end_direction(1))) > 1e-6:
                    raise ValueError(f"{row.angle} is at the middle of the cone, not on its border")
        return self


class LimitTable(Section):
    """A table of joint ranges; ``margin`` degrees are added to each limit."""

    name: str
    margin: float = Field(ge=0, le=90)
    sources: Mapping[str, str]
    joints: tuple[JointRange, ...]

    @model_validator(mode="after")
    def _check_references(self) -> LimitTable:
        for joint in self.joints:
            for row in joint.rows:
                if row.source not in self.sources:
                    raise ValueError(f"{joint.bone}, {row.angle}: no source {row.source!r} under 'sources'")
        bones = [joint.bone for joint in self.joints]
        for number, joint in enumerate(self.joints):
            if joint.bone in bones[:number]:
                raise ValueError(f"{joint.bone} is there twice")
            if joint.twist_with is not None and joint.twist_with not in bones[:number]:
                raise ValueError(f"{joint.bone}: 'twist_with' names no joint before it")
        return self


@dataclass(frozen=True)
class JointCoordinates(ABC):
    """Three coordinates (angles) of a joint of a skeleton, degrees: ``values`` (N, 3) in the methods.

    ``bone``: index of the bone of the joint. ``chain``: bones between this bone and its reference bone.
    ``before``, ``after``: (3, 3) rotations that convert the rotation of the joint to anatomical axes.
    ``offset`` (N,): what another joint adds to the third coordinate (twist).
    """

    range: JointRange
    side: int
    margin: float
    bone: int
    chain: tuple[int, ...]
    before: Array
    after: Array

    def measure(self, rotations: Array, offset: Array) -> Array:
        """Measure the coordinates (N, 3) of the joint from bone rotations (N, B, 3, 3)."""
        values = self.split(self.before @ self._inherited(rotations) @ rotations[:, self.bone] @ self.after)
        values[:, 2] = np.where(offset == 0, values[:, 2], values[:, 2] + offset)
        return values

    def bone_rotation(self, relative: Array, rotations: Array) -> Array:
        """Convert rotations (N, 3, 3) of the joint in anatomical axes to rotations (N, 3, 3) of the bone."""
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
        """Yield angle name, limit and values (N,) for both limits of a pair, in degrees."""
        for row, signed in zip(pair, (values, -values), strict=True):
            yield row.angle, row.degrees + self.margin, signed

    @abstractmethod
    def split(self, relative: Array) -> Array:
        """Convert rotations (N, 3, 3) in anatomical axes to coordinates (N, 3)."""

    @abstractmethod
    def compose(self, values: Array, offset: Array) -> Array:
        """Convert coordinates (N, 3) to rotations (N, 3, 3) in anatomical axes."""

    @abstractmethod
    def clamp(self, values: Array) -> Array:
        """Clamp coordinates (N, 3) to the limits."""

    @abstractmethod
    def named_angles(self, values: Array) -> dict[str, Array]:
        """Return the coordinates by the names of their angles: name -> (N,) degrees."""

    @abstractmethod
    def against_limits(self, values: Array) -> Iterator[tuple[str, float, Array]]:
        """Yield angle name, limit and values (N,) for each limit, in degrees."""


class HingeCoordinates(JointCoordinates):
    """Coordinates of rotations about three axes, one after the other."""

    @property
    def pairs(self) -> tuple[tuple[Limit, Limit], ...]:
        """Opposite limits about each axis."""
        assert self.range.first is not None and self.range.second is not None
        return (self.range.first, self.range.second, self.range.twist)

    @cached_property
    def axes(self) -> tuple[Array, float]:
        """Right-handed axes as columns (3, 3); and -1 if the third range turns the other way, else 1."""
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

    def clamp(self, values: Array) -> Array:
        return np.clip(values, *np.array([self.bounds(pair) for pair in self.pairs]).T)

    def named_angles(self, values: Array) -> dict[str, Array]:
        return {pair[0].angle: values[:, i] for i, pair in enumerate(self.pairs)}

    def against_limits(self, values: Array) -> Iterator[tuple[str, float, Array]]:
        for i, pair in enumerate(self.pairs):
            yield from self.pair_against_limits(pair, values[:, i])


class ConeCoordinates(JointCoordinates):
    """Coordinates of a bone in a cone: distance from the middle of the cone, azimuth about the middle, and
    twist. The twist is counted from the shortest rotation out of the middle."""

    @cached_property
    def middle(self) -> Array:
        """Direction (3,) of the middle of the cone."""
        assert self.range.along is not None
        return direction_vector(self.range.along, self.side)

    @cached_property
    def azimuth_axes(self) -> tuple[Array, Array]:
        """Two directions (3,) perpendicular to the middle, at azimuth 0 and 90 degrees."""
        first = self.range.twist[0]
        return direction_vector(first.start, self.side), direction_vector(first.towards, self.side)

    @cached_property
    def border(self) -> tuple[Array, Array]:
        """Border of the swing as azimuths (P,) and distances (P,) from the middle of the cone, degrees: the
        limits, widened by ``margin``."""
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
        # computed from azimuth and distance, not from the direction itself, so that compose() is the exact
        # inverse
        swing = _rotations_from_axis(self.middle, self._direction(azimuth, distance))
        u, v = self.azimuth_axes
        across = np.swapaxes(swing, -1, -2) @ relative @ u
        return np.stack([distance, azimuth, np.degrees(np.arctan2(across @ v, across @ u))], axis=-1)

    def compose(self, values: Array, offset: Array) -> Array:
        swing = _rotations_from_axis(self.middle, self._direction(values[:, 1], values[:, 0]))
        axis = np.asarray(np.cross(*self.azimuth_axes), dtype=float)
        return np.asarray(swing @ _about_axis(axis, np.radians(values[:, 2] - offset)))

    def clamp(self, values: Array) -> Array:
        distance, azimuth, twist = values.T
        clamped = np.minimum(distance, self._border_distance(azimuth))
        return np.stack([clamped, azimuth, np.clip(twist, *self.bounds(self.range.twist))], axis=-1)

    def named_angles(self, values: Array) -> dict[str, Array]:
        assert self.range.zero is not None
        direction = self._direction(values[:, 1], values[:, 0])
        zero = direction_vector(self.range.zero.direction, self.side)
        across = direction - (direction @ zero)[:, None] * zero
        length = np.linalg.norm(across, axis=-1)
        angle = np.degrees(np.arctan2(length, direction @ zero)) / np.maximum(length, 1e-12)
        out = {
            name: direction @ direction_vector(towards, self.side) * angle
            for name, towards in self.range.zero.angles.items()
        }
        return out | {self.range.twist[0].angle: values[:, 2]}

    def against_limits(self, values: Array) -> Iterator[tuple[str, float, Array]]:
        assert self.range.swing is not None
        distance, azimuth, twist = values.T
        beyond = distance - self._border_distance(azimuth)
        to_named = np.abs((azimuth[:, None] - self.border[0] + 180) % 360 - 180)
        nearest = np.argmin(to_named, axis=-1)
        for i, row in enumerate(self.range.swing):
            limit = row.degrees + self.margin
            yield row.angle, limit, np.where(nearest == i, limit + beyond, -np.inf)
        yield from self.pair_against_limits(self.range.twist, twist)


def _rotations_from_axis(start: Array, ends: Array) -> Array:
    """Shortest rotations (..., 3, 3) from ``start`` (3,), a unit vector along an axis, to ``ends`` (...,
    3)."""
    second = np.roll(start, 1)
    axes = np.stack([second, start, np.cross(second, start)], axis=-1)
    return np.asarray(axes @ quaternion_to_matrix(from_y_axis(ends @ axes)) @ axes.T)


def _about_axis(axis: Array, angles: NDArray[np.floating]) -> Array:
    """Rotations (N, 3, 3) about a unit vector (3,) by angles (N,) in radians."""
    half = angles[:, None] / 2
    return quaternion_to_matrix(np.concatenate([np.sin(half) * axis, np.cos(half)], axis=-1))


#: Rounding may put a clamped angle beyond its limit by this number of degrees.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class LimitViolation:
    """An angle that is beyond its limit in some frames. ``dataclasses.asdict`` turns it into JSON types.

    ``angle`` of a cone: the nearest direction that has a name in the table. The value of this angle is the
    limit plus the distance of the bone from the cone. ``limit``: degrees, with the margin of the table.
    ``worst``: largest value, degrees, in frame ``frame``. ``share``: share of the frames beyond the limit.
    """

    bone: str
    angle: str
    limit: float
    worst: float
    frame: int
    share: float


@dataclass(frozen=True)
class JointLimits:
    """A table of ranges, applied to a skeleton in any rest pose. Bones that the skeleton lacks are left out.
    Rotations are (N, B, 4) quaternions xyzw in bone space, as ``Retargeter.apply`` returns them."""

    table: LimitTable
    skeleton: Skeleton

    def for_skeleton(self, skeleton: Skeleton) -> JointLimits:
        """Apply the same ranges to another skeleton. Raises MotionError if the skeleton has none of the
        bones."""
        limits = replace(self, skeleton=skeleton)
        if not limits._joints:
            raise MotionError(f"joint limits {self.table.name!r} know no bone of this skeleton")
        return limits

    def angles(self, rotations: Array) -> dict[str, Array]:
        """Anatomical angles (N,) in degrees, by ``<bone>.<angle>``. An angle has the name of the first limit
        of its range: ``l_elbow.flexion`` is negative in extension. For shoulders and hips, the angle from
        hanging down is divided between flexion and abduction."""
        return {
            f"{self.skeleton.names[joint.bone]}.{angle}": value
            for joint, values, _ in self._measure(self._body_rotations(rotations))
            for angle, value in joint.named_angles(values).items()
        }

    def report(self, rotations: Array) -> list[LimitViolation]:
        """Report angles that are beyond their limits in any frame, bone by bone, each with its worst
        value."""
        violations = []
        for joint, measured, _ in self._measure(self._body_rotations(rotations)):
            for angle, limit, values in joint.against_limits(measured):
                beyond = values > limit + _ROUNDING
                if beyond.any():
                    frame = int(np.argmax(values))
                    bone, worst = self.skeleton.names[joint.bone], float(values[frame])
                    violations.append(LimitViolation(bone, angle, limit, worst, frame, float(beyond.mean())))
        return violations

    def clamp(self, rotations: Array) -> Array:
        """Set angles beyond a limit to the limit, in rotations (N, B, 4). Joints within their limits do not
        change. The result is continuous, except in three cases (docs/limits.md)."""
        body_rotations = self._body_rotations(rotations)
        out = np.array(rotations, dtype=float)
        rest = self.skeleton.rest[:, :3, :3]
        for joint, values, offset in self._measure(body_rotations):
            clamped = joint.clamp(values)
            moved = (clamped != values).any(-1)
            if not moved.any():
                continue
            relative = joint.compose(clamped[moved], offset[moved])
            rotation = joint.bone_rotation(relative, body_rotations[moved])
            body_rotations[moved, joint.bone] = rotation
            quaternion = matrix_to_quaternion(rest[joint.bone].T @ rotation @ rest[joint.bone])
            before = out[moved, joint.bone]
            same_sign = np.sum(quaternion * before, axis=-1, keepdims=True) >= 0
            out[moved, joint.bone] = np.where(same_sign, quaternion, -quaternion)
        return out

    def _measure(self, body_rotations: Array) -> Iterator[tuple[JointCoordinates, Array, Array]]:
        """Yield joints, parents first, with coordinates (N, 3) and offsets (N,). If the caller changes
        ``body_rotations`` (to clamp a joint), the joints that follow are measured with the change."""
        for joint, partner in self._joints:
            offset: Array = np.zeros(len(body_rotations))
            if partner is not None:
                offset = partner.measure(body_rotations, offset)[:, 2]
            yield joint, joint.measure(body_rotations, offset), offset

    def _body_rotations(self, rotations: Array) -> Array:
        """Bone rotations (N, B, 3, 3) relative to the parents, in the axes of the body at rest."""
        if np.ndim(rotations) != 3 or np.shape(rotations)[1:] != (len(self.skeleton), 4):
            raise MotionError(
                f"rotations of shape {np.shape(rotations)} are not (frames, {len(self.skeleton)} bones, 4)"
            )
        rest = self.skeleton.rest[:, :3, :3]
        return np.asarray(rest @ quaternion_to_matrix(rotations) @ np.swapaxes(rest, -1, -2))

    @cached_property
    def _joints(self) -> tuple[tuple[JointCoordinates, JointCoordinates | None], ...]:
        """Joints, parents first. Each comes with the joint that adds a twist to the joint, or None."""
        names = self.skeleton.names
        joints: dict[str, JointCoordinates] = {}
        rows = {bone: row for row in self.table.joints for bone in row.sides}
        for bone, row in rows.items():
            above = row.relative_to if row.relative_to in names else f"{bone[:2]}{row.relative_to}"
            chain = self._bones_between(names.index(bone), above) if bone in names else None
            if chain is None:
                continue
            kind = ConeCoordinates if row.swing is not None else HingeCoordinates
            before, after = (self._rest_axes(name, rows.get(name)) for name in (above, bone))
            side, number = row.sides[bone], names.index(bone)
            joints[bone] = kind(row, side, self.table.margin, number, chain, before.T, after)
            if row.hinge:
                joints[bone] = _as_hinge(joints[bone])
        return tuple(
            (joint, joints.get(f"{bone[:2]}{joint.range.twist_with}") if joint.range.twist_with else None)
            for bone, joint in sorted(joints.items(), key=lambda item: item[1].bone)
        )

    def _bones_between(self, bone: int, above: str) -> tuple[int, ...] | None:
        """Bones between a bone and its ancestor ``above``, from the ancestor down. None if ``above`` is not
        an ancestor."""
        chain: list[int] = []
        parent = int(self.skeleton.parents[bone])
        while parent >= 0 and self.skeleton.names[parent] != above:
            chain.insert(0, parent)
            parent = int(self.skeleton.parents[parent])
        return None if parent < 0 else tuple(chain)

    def _rest_axes(self, bone: str, row: JointRange | None) -> Array:
        """Anatomical axes (3, 3) of a bone at rest. The axes of a limb follow the bone, starting from a T
        pose."""
        if row is None or (row.along is None and not row.hinge):
            return np.eye(3)
        rest, side = self.skeleton.rest[self.skeleton.bone(bone), :3, :3], side_of(bone)
        if row.hinge:
            assert row.first is not None
            along, axis = direction_vector(row.first[0].start, side), row.first[0].axis(side)
            return np.asarray(rest @ np.stack([axis, along, np.cross(axis, along)]))
        assert row.along is not None
        return _rotations_from_axis(direction_vector(row.along, side), rest[:, 1])


def _as_hinge(joint: JointCoordinates) -> JointCoordinates:
    """Return coordinates of a joint in the axes of its bone. At rest, only the bend of the joint may differ
    from zero."""
    bend: Array = np.zeros((1, 3))
    if joint.range.along is not None:
        bend[0, 0] = joint.split((joint.before @ joint.after)[None])[0, 0]
    return replace(joint, before=joint.compose(bend, np.zeros(1))[0] @ joint.after.T)


def load_limits(path: str | os.PathLike[str] | None = None, skeleton: Skeleton | None = None) -> JointLimits:
    """Read a table of joint limits (YAML). By default, the limits are those of healthy adults, for the
    general skeleton.

    Raises:
        MotionError: The file is not a valid table. The error names file, line and key.
    """
    table = _built_in_table() if path is None else _read_table(path)
    return JointLimits(table, hanim_skeleton()).for_skeleton(skeleton or hanim_skeleton())


@lru_cache(maxsize=1)
def _built_in_table() -> LimitTable:
    return _read_table(resource_path("config/joint_limits/normal.yaml"))


def _read_table(path: str | os.PathLike[str]) -> LimitTable:
    data, tree = read_yaml(path, MotionError, "joint limits")
    return validated(LimitTable, data, MotionError, path, tree)
