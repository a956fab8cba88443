"""How far the joints of a person turn: ranges from a table (YAML), poses measured by it and put back into
it.

Angles are those of anatomy, from the neutral standing position (arms hanging, palms to the thighs), and
depend on no skeleton's rest pose or rolls. Hinges and the spine are split as the International Society of
Biomechanics does (Grood and Suntay 1983: about an axis of the bone above, a floating one, one of the bone
itself), shoulders and hips into the direction of the bone and the twist about it by the shortest way from a
direction amid its range. The directions allowed are a cone about it, through those that the table names
(reach cones: Wilhelms and Van Gelder 2001).
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from humansim_ros.body.skeleton import Skeleton, hanim_skeleton, side_of
from humansim_ros.errors import MotionError
from humansim_ros.io.yaml import read_yaml, validation_error
from humansim_ros.resources import resource_path
from humansim_ros.rotations import from_y_axis, matrix_to_quaternion, quaternion_to_matrix
from humansim_ros.types import Array

#: Anatomical directions; "out" is away from the middle of the body, so that both sides share a row.
Direction = Literal["up", "down", "front", "back", "left", "right", "out", "in"]
#: In body space: x is the person's left, y up, z front.
_DIRECTIONS: dict[str, tuple[float, float, float]] = {
    "up": (0.0, 1.0, 0.0),
    "down": (0.0, -1.0, 0.0),
    "front": (0.0, 0.0, 1.0),
    "back": (0.0, 0.0, -1.0),
    "left": (1.0, 0.0, 0.0),
    "right": (-1.0, 0.0, 0.0),
}
_BUILT_IN = "config/joint_limits/normal.yaml"
#: Degrees by which a clamped angle may be read as outside.
_ROUNDING = 1e-6


class _Row(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)


class Limit(_Row):
    """One end of a range: ``angle`` is its name; ``from`` is turned ``towards`` another direction by at most
    ``degrees``, says ``source``.
    """

    angle: str
    start: Direction = Field(alias="from")
    towards: Direction
    degrees: float = Field(ge=0, le=180)
    source: str

    def axis(self, side: int) -> Array:
        """The axis (3,) of its turn, on the left (1) or right (-1) side."""
        across = np.cross(_direction(self.start, side), _direction(self.towards, side))
        return np.asarray(across, dtype=float)

    def bone(self, side: int, margin: float = 0.0) -> Array:
        """Where it turns ``from`` (3,), and a margin (degrees) beyond."""
        angle = np.radians(self.degrees + margin)
        return np.asarray(
            np.cos(angle) * _direction(self.start, side) + np.sin(angle) * _direction(self.towards, side)
        )


class Zero(_Row):
    """What the direction of a bone is told by: degrees from ``direction`` towards those of ``angles``."""

    direction: Direction
    angles: Mapping[str, Direction]


class JointRow(_Row):
    """Ranges of ``bone`` (both sides of the limbs' bones) ``relative_to`` one above it.

    ``along``: where the bone points at zero; without it its rest pose is the zero. Either ``swing``, the
    directions on the border of its cone, and ``zero``; or ``first`` and ``second``, the axes before the
    twist. ``twist_with``: the bone whose twist counts too.
    """

    bone: str
    relative_to: str
    along: Direction | None = None
    zero: Zero | None = None
    swing: tuple[Limit, ...] | None = None
    first: tuple[Limit, Limit] | None = None
    second: tuple[Limit, Limit] | None = None
    twist: tuple[Limit, Limit]
    twist_with: str | None = None

    @property
    def rows(self) -> tuple[Limit, ...]:
        """All its limits."""
        return (*(self.swing or ()), *(self.first or ()), *(self.second or ()), *self.twist)

    @property
    def sides(self) -> dict[str, int]:
        """The bones it is for, and their sides."""
        names = hanim_skeleton().names
        found = {name: side_of(name) for name in (self.bone, f"l_{self.bone}", f"r_{self.bone}")}
        return {name: side for name, side in found.items() if name in names}

    @model_validator(mode="after")
    def _is_a_joint(self) -> JointRow:
        if not self.sides:
            raise ValueError(f"no bone {self.bone!r}; the bones are {', '.join(hanim_skeleton().names)}")
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
            along = _direction(self.along, 1)
            if not np.allclose(np.abs(axes[0]), np.abs(along)):
                raise ValueError(f"{self.twist[0].angle} is no twist about {self.along}")
            for row in self.swing:
                if not np.linalg.norm(np.cross(along, row.bone(1))) > 1e-6:
                    raise ValueError(f"{row.angle} is at the middle of the cone, not on its border")
        return self


class LimitTable(_Row):
    """A table of ranges; ``margin`` degrees are added to each."""

    name: str
    margin: float = Field(ge=0, le=90)
    sources: Mapping[str, str]
    joints: tuple[JointRow, ...]

    @model_validator(mode="after")
    def _refers_to_itself(self) -> LimitTable:
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
class Violation:
    """An angle beyond its limit: degrees, the worst value and its frame, and the share of frames beyond it.

    ``limit`` includes the table's margin. Of a cone, ``angle`` is the nearest direction that the table names,
    and values are as far beyond its limit as the bone is beyond the cone. ``dataclasses.asdict`` is JSON.
    """

    bone: str
    angle: str
    limit: float
    worst: float
    frame: int
    share: float


@dataclass(frozen=True)
class JointLimits:
    """A table of ranges applied to a skeleton, whatever its rest pose; bones it does not have are left out.

    Rotations are (N, B, 4) quaternions xyzw in bone space, as from ``Retargeter.apply``.
    """

    table: LimitTable
    skeleton: Skeleton

    def for_skeleton(self, skeleton: Skeleton) -> JointLimits:
        """The same ranges for another skeleton; MotionError if it has none of the bones."""
        limits = replace(self, skeleton=skeleton)
        if not limits._joints:
            raise MotionError(f"joint limits {self.table.name!r} know no bone of this skeleton")
        return limits

    def angles(self, rotations: Array) -> dict[str, Array]:
        """Anatomical angles (N,) in degrees, by ``<bone>.<angle>``: each range's first name, so that
        ``l_elbow.flexion`` is below 0 in extension. Of shoulders and hips, flexion and abduction share the
        way straight from hanging down.
        """
        out: dict[str, Array] = {}
        for joint, measured in self._measured(rotations):
            name = self.skeleton.names[joint.bone]
            out.update({f"{name}.{angle}": value for angle, value in joint.shown(measured).items()})
        return out

    def report(self, rotations: Array) -> list[Violation]:
        """The angles that are beyond their limits in some frame, bone by bone, the worst of each."""
        found = []
        for joint, measured in self._measured(rotations):
            for angle, limit, values in joint.against_limits(measured):
                beyond = values > limit + _ROUNDING
                if beyond.any():
                    frame = int(np.argmax(values))
                    found.append(
                        Violation(
                            self.skeleton.names[joint.bone],
                            angle,
                            limit,
                            float(values[frame]),
                            frame,
                            float(beyond.mean()),
                        )
                    )
        return found

    def clamp(self, rotations: Array) -> Array:
        """Rotations (N, B, 4) with every angle that is beyond its limit on it; what is inside stays as it is.

        Continuous, but where no clamping can be: with a bone opposite to the middle of its cone, a hinge half
        a turn from the middle of its range, or at a right angle out of its plane.
        """
        turns = self._turns(rotations)
        out = np.array(rotations, dtype=float)
        rest = self.skeleton.rest[:, :3, :3]
        for joint, measured in self._measured(rotations, turns):
            clamped = joint.clamp(measured)
            moved = (clamped != measured.values).any(-1)
            if not moved.any():
                continue
            turn = joint.turn(joint.compose(clamped[moved], measured.offset[moved]), turns[moved])
            turns[moved, joint.bone] = turn
            quaternion = matrix_to_quaternion(rest[joint.bone].T @ turn @ rest[joint.bone])
            before = out[moved, joint.bone]
            same_sign = np.sum(quaternion * before, axis=-1, keepdims=True) >= 0
            out[moved, joint.bone] = np.where(same_sign, quaternion, -quaternion)
        return out

    def _measured(self, rotations: Array, turns: Array | None = None) -> Iterator[tuple[_Joint, _Measured]]:
        """Joints, parents first, as they are in ``turns`` when their turn comes: a joint clamped by then
        carries the next.
        """
        turns = self._turns(rotations) if turns is None else turns
        for joint, partner in self._joints:
            offset: Array = np.zeros(len(turns))
            if partner is not None:
                offset = partner.measure(turns, offset).values[:, 2]
            yield joint, joint.measure(turns, offset)

    def _turns(self, rotations: Array) -> Array:
        """Turns (N, B, 3, 3) of bones from where their parents carry them, in axes of the body at rest."""
        if np.ndim(rotations) != 3 or np.shape(rotations)[1:] != (len(self.skeleton), 4):
            raise MotionError(
                f"rotations of shape {np.shape(rotations)} are not (frames, {len(self.skeleton)} bones, 4)"
            )
        rest = self.skeleton.rest[:, :3, :3]
        return np.asarray(rest @ quaternion_to_matrix(rotations) @ np.swapaxes(rest, -1, -2))

    @cached_property
    def _joints(self) -> tuple[tuple[_Joint, _Joint | None], ...]:
        """Joints, parents first, each with the one whose twist counts too."""
        names, joints = self.skeleton.names, {}
        along = {bone: row.along for row in self.table.joints for bone in row.sides}
        for row in self.table.joints:
            for bone, side in row.sides.items():
                above = row.relative_to if row.relative_to in names else f"{bone[:2]}{row.relative_to}"
                if bone not in names:
                    continue
                chain = self._between(names.index(bone), above)
                if chain is None:
                    continue
                joint = _Cone if row.swing is not None else _Hinge
                before, after = (self._zero(name, along.get(name)) for name in (above, bone))
                joints[bone] = joint(row, side, self.table.margin, names.index(bone), chain, before.T, after)
        return tuple(
            (joint, joints.get(f"{bone[:2]}{joint.row.twist_with}") if joint.row.twist_with else None)
            for bone, joint in sorted(joints.items(), key=lambda item: item[1].bone)
        )

    def _between(self, bone: int, above: str) -> tuple[int, ...] | None:
        """Bones between ``bone`` and one ``above`` it, top down; None if it is not above."""
        chain: list[int] = []
        parent = int(self.skeleton.parents[bone])
        while parent >= 0 and self.skeleton.names[parent] != above:
            chain.insert(0, parent)
            parent = int(self.skeleton.parents[parent])
        return None if parent < 0 else tuple(chain)

    def _zero(self, bone: str, along: Direction | None) -> Array:
        """Anatomical axes (3, 3) of a bone at rest: turned with a limb that does not rest as in a T pose."""
        if along is None:
            return np.eye(3)
        rest = self.skeleton.rest[self.skeleton.bone(bone), :3, 1]
        return _shortest(_direction(along, side_of(bone)), rest)


@dataclass(frozen=True)
class _Measured:
    """Coordinates (N, 3) of a joint, degrees; ``offset`` (N,) is what its partner adds to the third."""

    values: Array
    offset: Array


@dataclass(frozen=True)
class _Joint:
    """A joint of a skeleton: ``bone`` seen from another, ``chain`` bones lie between; ``before`` and
    ``after`` (3, 3) take its turn into anatomical axes.
    """

    row: JointRow
    side: int
    margin: float
    bone: int
    chain: tuple[int, ...]
    before: Array
    after: Array

    def measure(self, turns: Array, offset: Array) -> _Measured:
        """Its coordinates in turns (N, B, 3, 3)."""
        values = self.split(self.before @ self._carried(turns) @ turns[:, self.bone] @ self.after)
        values[:, 2] = np.where(offset == 0, values[:, 2], values[:, 2] + offset)
        return _Measured(values, offset)

    def turn(self, relative: Array, turns: Array) -> Array:
        """The bone's own turn (N, 3, 3) with which it lies as ``relative`` (N, 3, 3) says."""
        carried = np.swapaxes(self._carried(turns), -1, -2)
        return np.asarray(carried @ self.before.T @ relative @ self.after.T)

    def _carried(self, turns: Array) -> Array:
        product = np.broadcast_to(np.eye(3), (len(turns), 3, 3))
        for bone in self.chain:
            product = product @ turns[:, bone]
        return product

    def range(self, pair: Sequence[Limit]) -> tuple[float, float]:
        """Lowest and highest value of a pair of opposite limits."""
        return -pair[1].degrees - self.margin, pair[0].degrees + self.margin

    def pair_against_limits(self, pair: Sequence[Limit], values: Array) -> Iterator[tuple[str, float, Array]]:
        for row, signed in zip(pair, (values, -values), strict=True):
            yield row.angle, row.degrees + self.margin, signed

    def split(self, relative: Array) -> Array:
        raise NotImplementedError

    def compose(self, values: Array, offset: Array) -> Array:
        """What :meth:`measure` would split into these."""
        raise NotImplementedError

    def clamp(self, measured: _Measured) -> Array:
        raise NotImplementedError

    def shown(self, measured: _Measured) -> dict[str, Array]:
        raise NotImplementedError

    def against_limits(self, measured: _Measured) -> Iterator[tuple[str, float, Array]]:
        """(angle, limit, values (N,)) of each limit."""
        raise NotImplementedError


class _Hinge(_Joint):
    """Coordinates: the turns about three axes, one after the other."""

    @cached_property
    def pairs(self) -> tuple[tuple[Limit, Limit], ...]:
        assert self.row.first is not None and self.row.second is not None
        return (self.row.first, self.row.second, self.row.twist)

    @cached_property
    def axes(self) -> tuple[Array, float]:
        """The axes as columns, made right-handed (3, 3), and the sign of the third for that."""
        first, second, third = (pair[0].axis(self.side) for pair in self.pairs)
        made = np.cross(first, second)
        return np.stack([first, second, made], axis=-1), float(made @ third)

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
        turns = [_about(axes[:, i], angles[:, i]) for i in range(3)]
        return np.asarray(turns[0] @ turns[1] @ turns[2])

    def clamp(self, measured: _Measured) -> Array:
        return np.clip(measured.values, *np.array([self.range(pair) for pair in self.pairs]).T)

    def shown(self, measured: _Measured) -> dict[str, Array]:
        return {pair[0].angle: measured.values[:, i] for i, pair in enumerate(self.pairs)}

    def against_limits(self, measured: _Measured) -> Iterator[tuple[str, float, Array]]:
        for i, pair in enumerate(self.pairs):
            yield from self.pair_against_limits(pair, measured.values[:, i])


class _Cone(_Joint):
    """Coordinates: distance of the bone from the middle of the cone, azimuth around it, twist."""

    @cached_property
    def middle(self) -> Array:
        assert self.row.along is not None
        return _direction(self.row.along, self.side)

    @cached_property
    def around(self) -> tuple[Array, Array]:
        """Two directions (3,) across the middle, from which and towards which azimuths count."""
        first = self.row.twist[0]
        return _direction(first.start, self.side), _direction(first.towards, self.side)

    @cached_property
    def border(self) -> tuple[Array, Array]:
        """Azimuths and distances from the middle (P,) of the named directions and the margin, degrees."""
        assert self.row.swing is not None
        return self._polar(np.stack([row.bone(self.side, self.margin) for row in self.row.swing]))

    def _polar(self, directions: Array) -> tuple[Array, Array]:
        u, v = self.around
        across = np.stack([directions @ u, directions @ v])
        distance = np.arctan2(np.hypot(*across), directions @ self.middle)
        return np.degrees(np.arctan2(across[1], across[0])), np.degrees(distance)

    def _direction(self, azimuth: Array, distance: Array) -> Array:
        u, v = self.around
        azimuth, distance = np.radians(azimuth)[:, None], np.radians(distance)[:, None]
        return np.asarray(
            np.cos(distance) * self.middle + np.sin(distance) * (np.cos(azimuth) * u + np.sin(azimuth) * v)
        )

    def _farthest(self, azimuth: Array) -> Array:
        azimuths, distances = self.border
        return np.asarray(np.interp(azimuth, azimuths, distances, period=360.0))

    def split(self, relative: Array) -> Array:
        azimuth, distance = self._polar(relative @ self.middle)
        # not by the direction itself: the same way back as compose goes there
        swing = _shortest(self.middle, self._direction(azimuth, distance))
        u, v = self.around
        across = np.swapaxes(swing, -1, -2) @ relative @ u
        return np.stack([distance, azimuth, np.degrees(np.arctan2(across @ v, across @ u))], axis=-1)

    def compose(self, values: Array, offset: Array) -> Array:
        swing = _shortest(self.middle, self._direction(values[:, 1], values[:, 0]))
        axis = np.asarray(np.cross(*self.around), dtype=float)
        return np.asarray(swing @ _about(axis, np.radians(values[:, 2] - offset)))

    def clamp(self, measured: _Measured) -> Array:
        distance, azimuth, twist = measured.values.T
        farthest = np.minimum(distance, self._farthest(azimuth))
        return np.stack([farthest, azimuth, np.clip(twist, *self.range(self.row.twist))], axis=-1)

    def shown(self, measured: _Measured) -> dict[str, Array]:
        assert self.row.zero is not None
        direction = self._direction(measured.values[:, 1], measured.values[:, 0])
        zero = _direction(self.row.zero.direction, self.side)
        towards = {name: direction @ _direction(to, self.side) for name, to in self.row.zero.angles.items()}
        across = direction - (direction @ zero)[:, None] * zero
        length = np.linalg.norm(across, axis=-1)
        angle = np.degrees(np.arctan2(length, direction @ zero)) / np.maximum(length, 1e-12)
        return {name: part * angle for name, part in towards.items()} | {
            self.row.twist[0].angle: measured.values[:, 2]
        }

    def against_limits(self, measured: _Measured) -> Iterator[tuple[str, float, Array]]:
        assert self.row.swing is not None
        distance, azimuth, twist = measured.values.T
        beyond = distance - self._farthest(azimuth)
        to_named = np.abs((azimuth[:, None] - self.border[0] + 180) % 360 - 180)
        nearest = np.argmin(to_named, axis=-1)
        for i, row in enumerate(self.row.swing):
            limit = row.degrees + self.margin
            yield row.angle, limit, np.where(nearest == i, limit + beyond, -np.inf)
        yield from self.pair_against_limits(self.row.twist, twist)


def load_limits(path: str | os.PathLike[str] | None = None, skeleton: Skeleton | None = None) -> JointLimits:
    """The built-in ranges of healthy adults, or those of a YAML file, for a skeleton (the general one).

    Raises MotionError with file and key if it is no such table.
    """
    path = resource_path(_BUILT_IN) if path is None else path
    data, tree = read_yaml(path, MotionError, "joint limits")
    try:
        table = LimitTable.model_validate(data)
    except ValidationError as reason:
        raise validation_error(reason, tree, MotionError, path) from None
    return JointLimits(table, hanim_skeleton()).for_skeleton(skeleton or hanim_skeleton())


def _direction(name: str, side: int) -> Array:
    if name in ("out", "in"):
        return np.array([float(side) if name == "out" else -float(side), 0.0, 0.0])
    return np.array(_DIRECTIONS[name])


def _shortest(start: Array, ends: Array) -> Array:
    """Shortest rotations (..., 3, 3) of one unit vector (3,), along an axis, to others (..., 3)."""
    second = np.roll(start, 1)
    axes = np.stack([second, start, np.cross(second, start)], axis=-1)
    return np.asarray(axes @ quaternion_to_matrix(from_y_axis(ends @ axes)) @ axes.T)


def _about(axis: Array, angles: NDArray[np.floating]) -> Array:
    """Rotations (N, 3, 3) about a unit vector (3,) by radians (N,)."""
    half = angles[:, None] / 2
    return quaternion_to_matrix(np.concatenate([np.sin(half) * axis, np.cos(half)], axis=-1))
