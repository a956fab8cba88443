"""Motions as files store them, forward kinematics, poses of joints, and values that have rates of change.

Conventions, as in Blender's importer: the rotation of a joint is ``R_channel1 R_channel2 R_channel3`` in the
order of its channels, on column vectors. The translation always comes after the rotation, wherever its
channels are in the order.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from humansim_ros.errors import MotionError, printable, some_of, unknown
from humansim_ros.geometry import (
    VELOCITY_STEP,
    central_difference,
    find_cycle,
    levels,
    multiply_quaternions,
    normalised,
    quaternion_to_matrix,
    rotate,
    rotation_vector_to_quaternion,
    transform,
)
from humansim_ros.pictures import Pictured
from humansim_ros.types import Array, Indices

CHANNEL_NAMES = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
#: A frame number, a slice, or an array or list of frame numbers.
FrameIndex = int | slice | Sequence[int] | NDArray[np.integer]
_ALL = slice(None)
AXES = {"X": 0, "Y": 1, "Z": 2}


def refuse_cycle(names: Sequence[str], parents: Indices, path: str | os.PathLike[str] | None = None) -> None:
    """Raise MotionError, which names the joints, if the parents (J,) of joints have a cycle."""
    if cycle := find_cycle(parents):
        joints = some_of(printable(names[joint], 40) for joint in cycle)
        raise MotionError(f"the joints {joints} are their own ancestors: the tree has a cycle", path=path)


@dataclass(frozen=True, repr=False)
class Motion(Pictured):
    """A joint hierarchy and the values of its channels in each frame, as in the file.

    Attributes:
        joint_names: J names, parents before children. An end site is a joint without channels, with the name
            ``<parent>_end``.
        parents: (J,) index of the parent, -1 for a root.
        offsets: (J, 3) OFFSETs in file units.
        channels: Names of the channels of each joint.
        values: (F, C) channel values in file units and degrees.
        frame_time: Seconds from frame to frame.
        path: File of the motion.
        positions: Whether position channels replace the OFFSET or are added to it.
        unit: Metres per file unit. None if the file format does not define the unit.
        up: File axis that points up (``y``, ``-z``). None if unknown.
        is_rest_made: Whether the reader made the OFFSETs because the file has none. Such OFFSETs do not show
            which axis of the file points up.
        screen_up: Axis (``z``) that points up or down on the screen of the program that wrote the file. Empty
            if unknown.

    Raises:
        MotionError: The parents have a cycle, or a joint is before its parent.

    Example:
        >>> from humansim_ros import read_motion
        >>> motion = read_motion("walk")
        >>> motion.world_positions().shape  # frames, joints, xyz
        (121, 23, 3)
        >>> motion.world_positions(0)[motion.joint("Hips")].round(1).tolist()
        [8.5, 93.3, 1.0]
    """

    joint_names: tuple[str, ...]
    parents: Indices
    offsets: Array
    channels: tuple[tuple[str, ...], ...]
    values: Array
    frame_time: float
    path: str = field(default="", compare=False)
    positions: Literal["replace", "add"] = "replace"
    unit: float | None = None
    up: str | None = field(default=None, compare=False)
    is_rest_made: bool = field(default=False, compare=False)
    screen_up: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        late = np.flatnonzero(self.parents >= np.arange(len(self.parents)))
        if len(late):  # a cycle always has such a joint
            refuse_cycle(self.joint_names, self.parents, self.path)
            joint, parent = (self.joint_names[n] for n in (late[0], self.parents[late[0]]))
            raise MotionError(
                f"joint {joint!r} is before its parent {parent!r}: list parents first", path=self.path
            )

    def __repr__(self) -> str:
        name = f"{self.path!r}, " if self.path else ""
        return f"Motion({name}{self.n_frames} frames, {self.n_joints} joints, {self.duration:.2f} s)"

    @property
    def n_frames(self) -> int:
        """Number of frames F."""
        return len(self.values)

    @property
    def n_joints(self) -> int:
        """Number of joints J, end sites included."""
        return len(self.joint_names)

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return (self.n_frames - 1) * self.frame_time

    def joint(self, name: str) -> int:
        """Index of a joint. Raises MotionError if no joint has the name."""
        try:
            return self.joint_names.index(name)
        except ValueError:
            raise MotionError(unknown("joint", name, self.joint_names), path=self.path) from None

    def only(self, joints: Sequence[int]) -> Motion:
        """Keep only ``joints``, numbers in increasing order. A joint without its parent becomes a root."""
        number = {joint: place for place, joint in enumerate(joints)}
        return replace(
            self,
            joint_names=tuple(self.joint_names[joint] for joint in joints),
            parents=np.array([number.get(int(self.parents[joint]), -1) for joint in joints], dtype=np.intp),
            offsets=self.offsets[joints],
            channels=tuple(self.channels[joint] for joint in joints),
            values=self.values[:, [column for joint in joints for column in self.columns(joint)]],
        )

    @cached_property
    def _levels(self) -> tuple[Indices, ...]:
        return levels(self.parents)

    @cached_property
    def _columns(self) -> tuple[int, ...]:
        """First column of the channels of each joint in ``values``."""
        counts = [len(names) for names in self.channels]
        return tuple(int(n) for n in np.concatenate(([0], np.cumsum(counts)))[:-1])

    def columns(self, joint: int) -> range:
        """Columns of the channels of a joint in ``values``."""
        return range(self._columns[joint], self._columns[joint] + len(self.channels[joint]))

    @cached_property
    def position_columns(self) -> tuple[tuple[int, int, int], ...]:
        """All position channels: (joint, axis, column in ``values``)."""
        return tuple(
            (joint, AXES[name[0]], column)
            for joint, (names, start) in enumerate(zip(self.channels, self._columns, strict=True))
            for column, name in enumerate(names, start)
            if name.endswith("position")
        )

    def local_translations(self, frames: FrameIndex = _ALL) -> Array:
        """Translation of each joint relative to its parent (..., J, 3), file units. See :attr:`positions`."""
        values = self.values[frames]
        out = np.broadcast_to(self.offsets, (*values.shape[:-1], *self.offsets.shape)).copy()
        for joint, axis, column in self.position_columns:
            base = self.offsets[joint, axis] if self.positions == "add" else 0.0
            out[..., joint, axis] = base + values[..., column]
        return out

    def local_rotations(self, frames: FrameIndex = _ALL) -> Array:
        """Rotation of each joint relative to its parent (..., J, 4), quaternions xyzw."""
        values = self.values[frames]
        out = np.zeros((*values.shape[:-1], self.n_joints, 4))
        out[..., 3] = 1.0
        by_order: dict[tuple[int, ...], list[tuple[int, list[int]]]] = {}
        for joint, (names, start) in enumerate(zip(self.channels, self._columns, strict=True)):
            rotations = [(AXES[n[0]], c) for c, n in enumerate(names, start) if n.endswith("rotation")]
            if rotations:
                order = tuple(axis for axis, _ in rotations)
                by_order.setdefault(order, []).append((joint, [column for _, column in rotations]))
        for axes, group in by_order.items():
            columns = np.array([c for _, c in group])
            half = np.radians(values[..., columns]) / 2
            out[..., [joint for joint, _ in group], :] = _compose(np.sin(half), np.cos(half), axes)
        return out

    def world_transforms(self, frames: FrameIndex = _ALL) -> Array:
        """Joint frames (..., J, 4, 4) in file units and axes. For a single frame number, (J, 4, 4)."""
        return self.compose_world(self.local_translations(frames), self.local_rotations(frames))

    def compose_world(self, translations: Array, rotations: Array) -> Array:
        """Joint frames (..., J, 4, 4) from local translations (..., J, 3) and rotations (..., J, 4)."""
        return transform(*self._world(translations, quaternion_to_matrix(rotations)))

    def _world(self, translations: Array, rotations: Array) -> tuple[Array, Array]:
        world_r = np.array(np.broadcast_to(rotations, (*translations.shape[:-1], 3, 3)))
        world_t = np.array(translations)
        for level in self._levels[1:]:
            parents = self.parents[level]
            above = world_r[..., parents, :, :]
            world_t[..., level, :] = rotate(above, world_t[..., level, :]) + world_t[..., parents, :]
            world_r[..., level, :, :] = above @ world_r[..., level, :, :]
        return world_r, world_t

    def world_positions(self, frames: FrameIndex = _ALL) -> Array:
        """Joint positions (..., J, 3) in file units and axes. For a single frame number, (J, 3)."""
        rotations = quaternion_to_matrix(self.local_rotations(frames))
        return self._world(self.local_translations(frames), rotations)[1]

    def rest_positions(self) -> Array:
        """Joint positions (J, 3) in file units and axes, with no rotations and joints at their OFFSETs."""
        return self._world(self.offsets, np.broadcast_to(np.eye(3), (self.n_joints, 3, 3)))[1]


#: Order of the rotation channels of motions that are made from rotations.
_ORDER = "ZXY"


def motion_of_rotations(
    names: Sequence[str],
    parents: Indices,
    offsets: Array,
    rotations: Array,
    positions: Mapping[int, Array],
    frame_time: float,
    path: str = "",
    unit: float | None = None,
) -> Motion:
    """Make a motion from rotations (F, R, 3, 3) of the first R joints relative to their parents. The other
    joints are end sites.

    Args:
        names, parents, offsets, frame_time, path, unit: Fields of :class:`Motion`.
        rotations: The rotations.
        positions: Joint -> (F, 3) positions relative to its parent, for joints with position channels.
    """
    # imported here, since the import takes as long as all other imports of this module
    from scipy.spatial.transform import Rotation

    channels: list[tuple[str, ...]] = []
    values: list[Array] = []
    with warnings.catch_warnings():
        # SciPy warns about gimbal lock, but any of the possible angles is fine
        warnings.simplefilter("ignore", UserWarning)
        for joint in range(len(names)):
            own: tuple[str, ...] = ()
            if joint in positions:
                own = CHANNEL_NAMES[:3]
                values.append(positions[joint])
            if joint < rotations.shape[1]:
                own += tuple(f"{axis}rotation" for axis in _ORDER)
                values.append(Rotation.from_matrix(rotations[:, joint]).as_euler(_ORDER, degrees=True))
            channels.append(own)
    table = np.concatenate(values, axis=1)
    return Motion(tuple(names), parents, offsets, tuple(channels), table, frame_time, path, unit=unit)


def _compose(sine: Array, cosine: Array, axes: Sequence[int]) -> Array:
    """Quaternions (..., N, 4) of rotations about ``axes``, from sines and cosines of half angles (..., N,
    axes)."""
    total = np.zeros((*sine.shape[:-1], 4))
    total[..., 3] = 1.0
    for k, axis in enumerate(axes):
        s, c = sine[..., k], cosine[..., k]
        j, l = (axis + 1) % 3, (axis + 2) % 3  # noqa: E741
        rotated = np.empty_like(total)
        rotated[..., axis] = total[..., axis] * c + total[..., 3] * s
        rotated[..., j] = total[..., j] * c + total[..., l] * s
        rotated[..., l] = total[..., l] * c - total[..., j] * s
        rotated[..., 3] = total[..., 3] * c - total[..., axis] * s
        total = rotated
    return total


@dataclass(frozen=True)
class JointPoses:
    """Poses of J joints at N times, in ``map``.

    Attributes:
        names: J names.
        positions: (N, J, 3) metres.
        rotations: (N, J, 4) xyzw, relative to the rest pose of the motion with the person facing +x.
        linear: (N, J, 3) velocities in m/s. None if the source has no velocities.
        angular: (N, J, 3) angular velocities in rad/s. None if the source has no velocities.
    """

    names: tuple[str, ...]
    positions: Array
    rotations: Array
    linear: Array | None = None
    angular: Array | None = None

    @classmethod
    def with_velocities(
        cls,
        names: tuple[str, ...],
        positions: Array,
        rotations: Array,
        seconds: float | Array = 2 * VELOCITY_STEP,
        speed: float = 1.0,
    ) -> JointPoses:
        """Make poses at N times with velocities, as :func:`central_difference` computes them.

        Args:
            names: J names.
            positions: (3, N, J, 3) just before, at, and just after the times.
            rotations: (3, N, J, 4), as for ``positions``.
            seconds: Time between the first and the last of the three.
            speed: Factor of the velocities.
        """
        velocities = central_difference(positions, rotations, seconds)
        return cls(names, positions[1], rotations[1], *(speed * velocity for velocity in velocities))

    @property
    def _arrays(self) -> list[Array]:
        parts = (self.positions, self.rotations, self.linear, self.angular)
        return [part for part in parts if part is not None]

    def _changed(self, names: tuple[str, ...], change: Callable[[Array], Array]) -> JointPoses:
        """Return poses with joints ``names``, and with ``change`` applied to each array."""
        return JointPoses(names, *map(change, self._arrays))

    def contiguous(self) -> JointPoses:
        """Return the same poses in contiguous arrays, since sums of NumPy depend on the order in memory."""
        return self._changed(self.names, np.ascontiguousarray)

    def first(self, count: int) -> JointPoses:
        """Poses of the first joints."""
        return self._changed(self.names[:count], lambda part: part[:, :count])

    def named(self, names: tuple[str, ...]) -> JointPoses:
        """Poses of the named joints, in that order."""
        if names == self.names:
            return self
        index = {name: number for number, name in enumerate(self.names)}
        order = [index[name] for name in names]
        return self._changed(names, lambda part: part[:, order])

    def split(self, is_added: Callable[[str], bool]) -> tuple[JointPoses, JointPoses]:
        """Split off the joints at the end for which ``is_added(name)`` is true. Returns the poses of the
        joints before them, and the poses of the joints that were split off."""
        own = len(self.names)
        while own and is_added(self.names[own - 1]):
            own -= 1
        return self.first(own), self._changed(self.names[own:], lambda part: part[:, own:])

    def with_joints(
        self,
        names: Sequence[str],
        rotations: Array,
        angular: Array,
        positions: Array | None = None,
        linear: Array | None = None,
    ) -> JointPoses:
        """Add K joints at the end of a single pose (N = 1).

        Args:
            names: K names.
            rotations: (K, 4) xyzw.
            angular: Angular velocities (K, 3). They are not used if the pose has no velocities.
            positions: (K, 3). If None, the values of the first joint are used.
            linear: Velocities (K, 3). If None, the values of the first joint are used.
        """
        if positions is None or linear is None:
            positions, linear = self.at_first_joint(len(names))
        added = (positions, rotations, linear, angular)
        parts = (
            np.concatenate([own, new[None]], axis=1) for own, new in zip(self._arrays, added, strict=False)
        )
        return JointPoses((*self.names, *names), *parts)

    def at_first_joint(self, count: int) -> tuple[Array, Array]:
        """Positions and velocities (count, 3) for joints that are placed at the first joint of a single pose
        (N = 1)."""
        linear = np.zeros_like(self.positions) if self.linear is None else self.linear
        return np.repeat(self.positions[0, :1], count, axis=0), np.repeat(linear[0, :1], count, axis=0)

    def extrapolate(self, seconds: ArrayLike) -> JointPoses:
        """Poses at M times from a single pose (N = 1) that moves on with constant velocity. ``seconds``: (M,)
        after the single pose. Raises MotionError if the pose has no velocities."""
        if self.linear is None or self.angular is None:
            raise MotionError("these joints have no velocities")
        steps = np.asarray(seconds, dtype=float)[:, None, None]
        positions = self.positions + self.linear * steps
        turns = rotation_vector_to_quaternion(self.angular * steps)
        return JointPoses(self.names, positions, multiply_quaternions(turns, normalised(self.rotations)))


@dataclass(frozen=True, eq=False)
class Rated:
    """Values of a human at one time and their rates of change: weights of face actions, or swing of cloth.

    Attributes:
        labels: Names of all values, in the order of ``values.ravel()``.
        values, rates: Values of any shape, and the change of each value per second.
        limits: Smallest and largest value.
    """

    labels: tuple[str, ...]
    values: Array
    rates: Array
    limits: tuple[float, float] = (-math.inf, math.inf)

    @classmethod
    def at_rest(
        cls,
        labels: tuple[str, ...],
        shape: tuple[int, ...],
        limits: tuple[float, float] = (-math.inf, math.inf),
    ) -> Rated:
        """Create values of zero with rates of zero."""
        return cls(labels, np.zeros(shape), np.zeros(shape), limits)

    def moving(self, values: Array, seconds: float) -> Rated:
        """Return values and rates at the second of three times, with the same labels. ``values``: values at
        the three times. ``seconds``: time from the first to the third."""
        return replace(self, values=values[1], rates=(values[2] - values[0]) / seconds)

    def after(self, seconds: float) -> Array:
        """Return the values ``seconds`` later, with constant rates, within the limits."""
        return np.clip(self.values + seconds * self.rates, *self.limits)

    def stopped(self) -> Rated:
        """The same values with rates of zero."""
        return replace(self, rates=np.zeros_like(self.rates))

    @property
    def weights(self) -> Array:
        """Former name of the ``values`` of a face."""
        return self._renamed("weights")

    @property
    def offsets(self) -> Array:
        """Former name of the ``values`` of a swing."""
        return self._renamed("offsets")

    def _renamed(self, name: str) -> Array:
        warnings.warn(f"{name} is deprecated: use values", DeprecationWarning, stacklevel=3)
        return self.values
