"""Keyframes of an object: position, rotation and size over time, applied to objects and joints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike

from humansim_ros.errors import MotionError
from humansim_ros.motion.joint_poses import VELOCITY_STEP, JointPoses, central_difference
from humansim_ros.rotations import matrix_to_quaternion, quaternion_to_matrix
from humansim_ros.types import Array

KeyframeLoop = Literal["none", "repeat"]

#: Names of two joints at the end of a message that show the keyframed space of a motion: its origin, and the
#: end of its unit vector along x, which is as long as the size of the person.
SPACE_JOINTS = ("keyframes", "keyframes_end")
#: Frames per second of an animation that gives none.
DEFAULT_RATE = 30.0
#: Smallest factor of a size.
SMALLEST_SIZE = 1e-6


@dataclass(frozen=True)
class KeyframePose:
    """Pose and size of an object at some times (...).

    ``position``: (..., 3) in ``map``, metres. ``rotation``: (..., 3) degrees about x, y and z. ``size``:
    (..., 3) factors along x, y and z of the object.
    """

    position: Array
    rotation: Array
    size: Array

    @property
    def quaternion(self) -> Array:
        """(..., 4) xyzw of R = Rz Ry Rx: about the fixed x axis first, then y, then z [thesis §9.2]."""
        angles = self.rotation.reshape(-1, 3)
        rotation = scipy.spatial.transform.Rotation.from_euler("xyz", angles, degrees=True)
        return np.asarray(rotation.as_quat().reshape(*self.rotation.shape[:-1], 4))


@dataclass(frozen=True)
class KeyframeTimeline:
    """Frames ``start`` to ``end`` at ``rate`` per second; ``start`` is at second 0 of the scene.

    ``loop``: ``none`` holds the ends, ``repeat`` starts again at ``end``.
    """

    start: int
    end: int
    rate: float = DEFAULT_RATE
    loop: KeyframeLoop = "none"

    @property
    def duration(self) -> float:
        """Seconds from start to end."""
        return (self.end - self.start) / self.rate

    def cycles(self, seconds: Array) -> Array:
        """Number of the cycle of the loop at each time; 0 without a loop."""
        if self.loop == "none" or self.end == self.start:
            return np.zeros_like(seconds)
        return np.floor(seconds / self.duration + 1e-9)

    def frames(self, seconds: Array, cycles: Array) -> Array:
        """Frame numbers, with fractions, of times in the given cycles."""
        frame = self.start + (seconds - cycles * self.duration) * self.rate
        return np.asarray(np.clip(frame, self.start, self.end))


@dataclass(frozen=True)
class KeyframeTrack:
    """The keys of one object, linear in position, angles and size between them.

    Attributes:
        timeline: Timeline of the animation.
        frames: (K,) increasing whole numbers.
        positions: (K, 3) as in :class:`KeyframePose`.
        rotations: (K, 3) as in :class:`KeyframePose`.
        sizes: (K, 3) as in :class:`KeyframePose`.

    Raises:
        MotionError: The keys are not finite, not in order or outside the timeline, or a size is not positive.
    """

    timeline: KeyframeTimeline
    frames: Array
    positions: Array
    rotations: Array
    sizes: Array

    def __post_init__(self) -> None:
        columns = (self.positions, self.rotations, self.sizes)
        n = len(self.frames)
        if n == 0 or any(column.shape != (n, 3) for column in columns):
            raise MotionError(f"{n} keys cannot have arrays of shapes {[c.shape for c in columns]}")
        if not all(np.isfinite(column).all() for column in (self.frames, *columns)):
            raise MotionError("a key is not finite (NaN or infinity)")
        whole = (self.frames == np.round(self.frames)).all() and (np.diff(self.frames) > 0).all()
        if not whole or self.frames[0] < self.timeline.start or self.frames[-1] > self.timeline.end:
            raise MotionError("keys need whole frame numbers that rise, within the timeline's start to end")
        if not (self.sizes > 0).all():
            raise MotionError("a size must be above 0")

    def at(self, seconds: ArrayLike) -> KeyframePose:
        """Pose at times (...), seconds of the scene; constant before the first and after the last key."""
        times = np.asarray(seconds, dtype=float)
        return self._interpolate(self.timeline.frames(times, self.timeline.cycles(times)))

    def around(self, seconds: float, step: float = VELOCITY_STEP) -> tuple[Array, KeyframePose]:
        """Times (3,) a step before, at, and a step after ``seconds``, and the poses there.

        The times do not cross a jump to the start of the animation.
        """
        times = seconds + np.array([-step, 0.0, step])
        cycle = float(self.timeline.cycles(np.array(seconds)))
        if self.timeline.loop == "repeat" and self.timeline.duration > 0:
            start, end = cycle * self.timeline.duration, (cycle + 1) * self.timeline.duration
            times = np.clip(times, min(start, seconds), max(end, seconds))
        return times, self._interpolate(self.timeline.frames(times, np.full(3, cycle)))

    def apply(self, poses: JointPoses, seconds: float) -> JointPoses:
        """Move, rotate and scale joints (N = 1) with their space, velocities included.

        :data:`SPACE_JOINTS` follow the joints. ``sizes`` must be the same along all axes.
        """
        times, key = self.around(seconds)
        moving = poses if poses.linear is None else poses.extrapolate(times - seconds)
        n = len(times)
        space = np.broadcast_to(np.array([[0.0, 0, 0], [1, 0, 0]]), (n, 2, 3))
        identity = np.broadcast_to(np.array([0.0, 0, 0, 1]), (n, 2, 4))
        positions = np.broadcast_to(moving.positions, (n, *moving.positions.shape[1:]))
        rotations = np.broadcast_to(moving.rotations, (n, *moving.rotations.shape[1:]))
        rotation = quaternion_to_matrix(key.quaternion)
        positions = np.concatenate([positions, space], axis=1) * key.size[:, None, :1]
        positions = key.position[:, None] + np.einsum("nij,nkj->nki", rotation, positions)
        rotations = np.concatenate([rotations, identity], axis=1)
        rotations = matrix_to_quaternion(rotation[:, None] @ quaternion_to_matrix(rotations))
        linear = angular = None
        if poses.linear is not None:
            linear, angular = (
                velocity[None]
                for velocity in central_difference(
                    positions[0], positions[2], rotations[0], rotations[2], max(times[2] - times[0], 1e-12)
                )
            )
        names = (*poses.names, *SPACE_JOINTS)
        return JointPoses(names, positions[1:2], rotations[1:2], linear, angular)

    def _interpolate(self, frames: Array) -> KeyframePose:
        last = len(self.frames) - 1
        after = np.clip(np.searchsorted(self.frames, frames, side="right"), 0, last)
        before = np.maximum(after - 1, 0)
        span = np.where(after > before, self.frames[after] - self.frames[before], 1.0)
        weight = np.clip((frames - self.frames[before]) / span, 0.0, 1.0)[..., None]
        return KeyframePose(
            *(
                (1 - weight) * values[before] + weight * values[after]
                for values in (self.positions, self.rotations, self.sizes)
            )
        )


@dataclass(frozen=True)
class KeyframeSpace:
    """Space of a motion in ``map`` at N times, as keyframes move it: ``x' = position + size rotation x``.

    ``position``: (N, 3). ``rotation``: (N, 3, 3). ``size``: (N,).
    """

    position: Array
    rotation: Array
    size: Array

    def to_map(self, frames: Array) -> Array:
        """Frames (N, J, 4, 4) of that space in ``map``: moved and rotated; their positions scaled."""
        moved = np.array(frames)
        moved[..., :3, :3] = self.rotation[:, None] @ frames[..., :3, :3]
        positions = self.size[:, None, None] * frames[..., :3, 3]
        moved[..., :3, 3] = self.position[:, None] + np.einsum("nij,nkj->nki", self.rotation, positions)
        return moved


def undo_keyframes(poses: JointPoses) -> tuple[JointPoses, KeyframeSpace | None]:
    """Invert :meth:`KeyframeTrack.apply` at N times.

    Returns:
        Joint poses without keyframes and without velocities, and the space that the keyframes moved. Joints
        without :data:`SPACE_JOINTS` are returned unchanged, with None.

    Raises:
        MotionError: :data:`SPACE_JOINTS` are at one place.
    """
    if poses.names[-2:] != SPACE_JOINTS:
        return poses, None
    origin, end = poses.positions[:, -2], poses.positions[:, -1]
    size = np.linalg.norm(end - origin, axis=-1)
    if not (size >= SMALLEST_SIZE / 2).all():
        raise MotionError(f"the joints {' and '.join(SPACE_JOINTS)} are at one place: a size of zero")
    rotation = quaternion_to_matrix(poses.rotations[:, -2])
    positions = np.einsum("nji,nkj->nki", rotation, poses.positions[:, :-2] - origin[:, None])
    back = np.swapaxes(rotation, -1, -2)[:, None]
    rotations = matrix_to_quaternion(back @ quaternion_to_matrix(poses.rotations[:, :-2]))
    original = JointPoses(poses.names[:-2], positions / size[:, None, None], rotations)
    return original, KeyframeSpace(origin, rotation, size)
