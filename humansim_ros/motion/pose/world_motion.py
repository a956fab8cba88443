"""Motions placed in ``map``, in metres: cut, looped and sampled at any time; and warnings about them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, Protocol

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from humansim_ros.errors import MotionError, some_of
from humansim_ros.geometry import (
    VELOCITY_STEP,
    WORLD_FROM_BODY,
    matrix_to_quaternion,
    multiply_quaternions,
    normalised,
    slerp,
    smooth_step,
    unit_vectors,
)
from humansim_ros.motion.body.kinematics import JointPoses, Motion
from humansim_ros.motion.matching.by_shape import match_motion
from humansim_ros.motion.matching.file_frame import BodyLines, FileFrame, detect_file_frame
from humansim_ros.motion.matching.joint_tables import JointMatch, opposite_joints
from humansim_ros.types import Array, Indices

#: A step is a jump if it is faster than the first value (m/s) and longer than the second (metres). The
#: fastest run is 12.4 m/s.
_MAX_SPEED, _MIN_DISTANCE = 15.0, 0.3
#: Frames between two jumps are a recording error if they last less than the first value (seconds), and less
#: than the second value as a share of the longest part without a jump.
_ERROR_SECONDS, _ERROR_SHARE = 0.5, 0.25
#: If a person stands still, channels vary by less than this value, degrees or file units.
_STILL = 0.1


@dataclass(frozen=True)
class Jump:
    """A jump to ``frame`` from the frame before it, over a ``distance`` in metres."""

    frame: int
    distance: float


def joint_path(motion: Motion, joint: int) -> Array:
    """Positions (F, 3) of one joint in all frames, file units; computes only the joints above it."""
    chain = [joint]
    while motion.parents[chain[0]] >= 0:
        chain.insert(0, int(motion.parents[chain[0]]))
    return motion.only(chain).world_positions()[:, -1]


def find_jumps(path: Array, frame_time: float) -> tuple[Jump, ...]:
    """Find jumps of a joint at positions ``path`` (F, 3), metres. A jump is a step that is too long for a
    person, and unlike both neighbouring steps. So a person in a moving car does not jump."""
    if len(path) < 2:
        return ()
    steps = np.diff(path, axis=0)
    limit = max(_MIN_DISTANCE, _MAX_SPEED * frame_time)
    changes = np.linalg.norm(np.diff(steps, axis=0), axis=1)
    lengths = np.linalg.norm(steps, axis=1)
    jumps = (lengths > limit) & (np.append(np.inf, changes) > limit) & (np.append(changes, np.inf) > limit)
    return tuple(Jump(int(step) + 1, float(lengths[step])) for step in np.flatnonzero(jumps))


def leading_rest(motion: Motion, jumps: Sequence[Jump]) -> int:
    """Number of frames of a rest pose before the first jump. 0 if the first frames are no rest pose.

    Some programs write a rest pose at the origin as the first frames; the person is elsewhere. Frames are a
    rest pose if all rotations are zero. They are also a rest pose if the root is at or above the origin of
    the file, and they are fewer than half of the frames.
    """
    first = jumps[0].frame if jumps else 0
    before = motion.values[:first]
    if not before.size or np.ptp(before, axis=0).max() > _STILL:
        return 0
    rotations = [
        column
        for joint, names in enumerate(motion.channels)
        for column, name in zip(motion.columns(joint), names, strict=True)
        if name.endswith("rotation")
    ]
    is_zero = np.abs(before[:, rotations]).max(initial=0.0) < _STILL
    at_origin = [
        abs(before[0, c]) < _STILL for joint, _, c in motion.position_columns if motion.parents[joint] < 0
    ]
    is_at_origin = sum(at_origin) >= 2 and 2 * first < motion.n_frames
    return first if is_zero or is_at_origin else 0


def steady_frames(motion: Motion, jumps: Sequence[Jump]) -> NDArray[np.bool_]:
    """Whether each frame (F,) shows where the person is: no rest frame at the start, no recording error."""
    steady = np.ones(motion.n_frames, dtype=bool)
    if not jumps:
        return steady
    edges = [0, *(jump.frame for jump in jumps), motion.n_frames]
    lengths = np.diff(edges)
    shortest = min(_ERROR_SECONDS / motion.frame_time, _ERROR_SHARE * lengths.max())
    for start, length in zip(edges, lengths.tolist(), strict=False):
        steady[start : start + length] = length >= shortest
    steady[: leading_rest(motion, jumps)] = False
    return steady if steady.any() else ~steady


MotionLoop = Literal["none", "repeat", "continue"]
Anchor = Literal["start", "center", "file"]

#: Shortest part that can be played, seconds, unless the file is shorter. Cycles of nearly no time could not
#: be counted.
_SHORTEST_PART = 1e-3


@dataclass(frozen=True)
class Placement:
    """Place of a motion in ``map``: its anchor is at ``position`` (x, y), rotated by ``yaw`` radians.

    ``anchor``: ``start`` is the root in the first frame, ``center`` the middle of the ground that the motion
    covers, ``file`` the origin of the file. Only frames of :func:`steady_frames` count.
    """

    position: tuple[float, float] = (0.0, 0.0)
    yaw: float = 0.0
    anchor: Anchor = "start"


class PoseCorrection(Protocol):
    """A correction of poses in ``map``. For example, feet that stay in place on the floor."""

    def apply(self, poses: JointPoses, phases: Array, cycle_rotations: Array) -> JointPoses:
        """Correct poses. ``phases``: (N,) seconds of the file since the start of the cycle.
        ``cycle_rotations``: (N, 3, 3) rotation from the first cycle to the cycle of each pose."""
        ...


@dataclass(frozen=True)
class WorldMotion:
    """A motion in ``map``: metres, z up, the floor at 0.

    Attributes:
        motion: Motion of a file.
        match: Joints of the motion that drive bones.
        frame: Coordinate frame of the file.
        placement: Place of the motion in ``map``.
        loop: ``none`` holds the last frame. ``repeat`` jumps to the first frame. ``continue`` goes on from
            the last position and heading, so that a walk cycle walks on.
        start: Start of the part of the file to play, seconds of the file.
        end: End of that part, seconds of the file. If None, the last frame.
        speed: Seconds of the file that are played in a second.
        blend: Seconds of the file over which the end of a cycle fades into the start of the next. Each cycle
            is shorter by this time.
        mirror: Whether to swap left and right. The motion is reflected in the vertical plane through the
            placement along its heading.
        correction: Correction of each sample, for example feet that stay in place; or None.

    Raises:
        MotionError: Start, end, speed and blend contradict each other or the motion.
    """

    motion: Motion
    match: JointMatch
    frame: FileFrame
    placement: Placement = Placement()
    loop: MotionLoop = "repeat"
    start: float = 0.0
    end: float | None = None
    speed: float = 1.0
    blend: float = 0.0
    mirror: bool = False
    correction: PoseCorrection | None = None

    def __post_init__(self) -> None:
        duration = self.motion.duration
        end = self._end
        problem = ""
        if not 0 <= self.start <= duration:
            problem = f"start is {self.start:g} s, outside the motion's 0 to {duration:g} s"
        elif not self.start < end + (duration == 0):
            problem = f"end ({end:g} s) must come after start ({self.start:g} s)"
        elif end - self.start < min(_SHORTEST_PART, duration):
            problem = f"end must come at least {_SHORTEST_PART:g} s after start ({self.start:g} s)"
        elif not 0 <= self.speed < np.inf:
            problem = f"speed must be 0 or more, not {self.speed:g}"
        elif not 0 <= self.blend <= (end - self.start) / 2:
            problem = f"blend ({self.blend:g} s) must be at most half of what plays ({end - self.start:g} s)"
        if problem:
            raise MotionError(problem, path=self.motion.path)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.motion.joint_names

    @cached_property
    def jumps(self) -> tuple[Jump, ...]:
        """Jumps of the person in the whole file."""
        return find_jumps(self._hips_path, self.motion.frame_time)

    @property
    def _end(self) -> float:
        """End of the played part, seconds of the file. It is never after the last frame."""
        return self.motion.duration if self.end is None else min(self.end, self.motion.duration)

    @property
    def cycle_length(self) -> float:
        """Length of a cycle of the loop, seconds of the file."""
        return self._end - self.start - (self.blend if self.loop != "none" else 0.0)

    @property
    def duration(self) -> float:
        """Seconds that a cycle takes at this speed. Infinite if the speed is 0."""
        return self.cycle_length / self.speed if self.speed else np.inf

    @property
    def frame_times(self) -> Array:
        """Times (N,) of the frames of the file in a cycle, seconds of the file since ``start``."""
        step = self.motion.frame_time
        first = int(np.ceil(self.start / step - 1e-6))
        last = int(np.floor((self.start + self.cycle_length) / step + 1e-6))
        return np.maximum(np.arange(first, max(first, last) + 1) * step - self.start, 0.0)

    def file_times(self, times: ArrayLike, file_offset: float = 0.0) -> Array:
        """Total seconds of the file (N,) played before the times, over all cycles, plus ``file_offset``."""
        return np.atleast_1d(np.asarray(times, dtype=float)) * self.speed + file_offset

    def phases(self, times: ArrayLike, file_offset: float = 0.0) -> Array:
        """Times (N,) in the file, seconds, that play at ``times`` (N,)."""
        t = self.file_times(times, file_offset)
        return self.start + np.clip(t - self._cycles(t) * self.cycle_length, 0.0, self.cycle_length)

    def sample(self, times: ArrayLike, file_offset: float = 0.0) -> JointPoses:
        """Joint poses at N times in seconds. Rotations of joints are interpolated between frames (slerp),
        before forward kinematics. ``file_offset``: seconds of the file that are added to all times, so that a
        motion can change its speed and go on from the same pose."""
        t = self.file_times(times, file_offset)
        return self._sample(t, self._cycles(t))

    def sample_with_velocities(self, times: ArrayLike, file_offset: float = 0.0) -> JointPoses:
        """Do the same as :meth:`sample`, with velocities. Velocities are central differences over two
        milliseconds. They cross neither a jump to the start of the motion nor the end of its last cycle."""
        t = self.file_times(times, file_offset)
        cycles = self._cycles(t)
        step = VELOCITY_STEP * max(self.speed, 1e-6)
        early, late = t - step, t + step
        if self.loop == "continue" or (self.loop == "repeat" and self.blend > 0):
            # nothing fades into the first cycle, since no cycle comes before it
            early = np.where(cycles == 0, np.maximum(early, 0.0), early)
            all_cycles = np.concatenate([self._cycles(early), cycles, self._cycles(late)])
        else:
            start, end = cycles * self.cycle_length, (cycles + 1) * self.cycle_length
            early, late = np.clip(early, start, end), np.clip(late, start, end)
            all_cycles = np.tile(cycles, 3)
        poses = self._sample(np.concatenate([early, t, late]), all_cycles)
        seconds = np.maximum(late - early, 1e-12)[:, None, None]
        places, turns = poses.positions.reshape(3, len(t), -1, 3), poses.rotations.reshape(3, len(t), -1, 4)
        return JointPoses.with_velocities(self.names, places, turns, seconds, self.speed)

    def cycle_rotations(self, cycles: Array) -> Array:
        """Rotations (N, 3, 3) about the vertical, from the first cycle of the loop to cycles (N,)."""
        if self.loop != "continue" or self.cycle_length <= 0:
            return np.broadcast_to(np.eye(3), (len(cycles), 3, 3))
        rotation, _ = self._cycle_transforms(cycles)
        return np.swapaxes(rotation, -1, -2) if self.mirror else rotation

    @cached_property
    def _rotations(self) -> Array:
        return self.motion.local_rotations()

    @cached_property
    def _translations(self) -> Array:
        return self.motion.local_translations()

    @cached_property
    def _map_from_file(self) -> Array:
        """Rotation (3, 3) from file axes to ``map``, with yaw."""
        return yaw_matrices(self.placement.yaw) @ self.frame.world_from_file

    @cached_property
    def _hips_path(self) -> Array:
        """Positions (F, 3) of the hips, metres, file axes."""
        return self.frame.unit * joint_path(self.motion, self.match.roles["Hips"])

    @cached_property
    def steady_frames(self) -> Indices:
        """Numbers of the frames in the played part that show where the person is."""
        step = self.motion.frame_time
        first, last = (int(np.floor(t / step + 1e-6)) for t in (self.start, self._end))
        played = np.arange(first, last + 1)
        steady = played[steady_frames(self.motion, self.jumps)[played]]
        return steady if len(steady) else played

    @cached_property
    def _translation(self) -> Array:
        """Translation (3,) in ``map`` that puts the anchor in its place and the feet on the floor."""
        frames = self.steady_frames[:: max(1, (len(self.steady_frames) - 1) // 500)]
        points = self.motion.world_positions(frames) @ (self.frame.unit * self._map_from_file).T
        root = points[:, self.match.roles["Hips"], :2]
        anchor = {"start": root[0], "center": (root.min(0) + root.max(0)) / 2, "file": np.zeros(2)}[
            self.placement.anchor
        ]
        floor = floor_height(points[..., 2].min(1))
        return np.array([*(np.array(self.placement.position) - anchor), -floor])

    def _cycles(self, times: Array) -> Array:
        """Number of the cycle of the loop (N,) at file times (N,)."""
        if self.loop == "none" or self.cycle_length <= 0:
            return np.zeros_like(times)
        return np.floor(times / self.cycle_length + 1e-9)

    def _sample(self, times: Array, cycles: Array) -> JointPoses:
        length = self.cycle_length
        phases = np.clip(times - cycles * length, 0, length)
        positions, rotations = self._to_map(*self._blended_local_poses(phases, cycles))
        if self.loop == "continue" and length > 0:
            cycle_rotation, cycle_translation = self._cycle_transforms(cycles)
            positions = np.einsum("nij,nkj->nki", cycle_rotation, positions) + cycle_translation[:, None]
            rotations = cycle_rotation[:, None] @ rotations
        if self.mirror:
            positions, rotations = self._mirrored(positions, rotations)
        poses = JointPoses(self.names, positions, matrix_to_quaternion(rotations))
        if self.correction is None:
            return poses
        return self.correction.apply(poses, phases, self.cycle_rotations(cycles))

    def _local_poses(self, times: Array) -> tuple[Array, Array]:
        """Local translations (N, J, 3) and rotations (N, J, 4) at file times: slerp between frames."""
        last = self.motion.n_frames - 1
        place = np.clip(times / self.motion.frame_time, 0, last)
        # a time that differs from a frame only by rounding is that frame
        place = np.where(np.abs(place - np.round(place)) < 1e-6, np.round(place), place)
        before = np.floor(place).astype(int)
        after = np.minimum(before + 1, last)
        fraction = (place - before)[:, None]
        rotations = slerp(self._rotations[before], self._rotations[after], fraction)
        start, end = self._translations[before], self._translations[after]
        return start + fraction[..., None] * (end - start), rotations

    def _blended_local_poses(self, phases: Array, cycles: Array) -> tuple[Array, Array]:
        """Local poses at phases (N,). The end of a cycle fades into the start of the next one."""
        translations, rotations = self._local_poses(self.start + phases)
        if self.blend == 0 or self.loop == "none":
            return translations, rotations
        fading = np.flatnonzero((cycles != 0) & (phases < self.blend))
        if len(fading):
            t, r = self._local_poses(self.start + self.cycle_length + phases[fading])
            roots = np.flatnonzero(self.motion.parents < 0)
            t[:, roots], r[:, roots] = self._minus_one_cycle(t[:, roots], r[:, roots])
            weight = smooth_step(phases[fading] / self.blend)[:, None]
            translations[fading] = t + weight[..., None] * (translations[fading] - t)
            rotations[fading] = slerp(r, rotations[fading], weight)
        return translations, rotations

    def _minus_one_cycle(self, translations: Array, rotations: Array) -> tuple[Array, Array]:
        """Move local poses of root joints back by the movement of ``continue`` in one cycle."""
        if self.loop != "continue":
            return translations, rotations
        cycle_rotation, cycle_translation = (part[0] for part in self._cycle_transforms(np.ones(1)))
        unit, axes, offset = self.frame.unit, self._map_from_file, self._translation
        placed = (unit * translations @ axes.T + offset - cycle_translation) @ cycle_rotation
        back = scipy.spatial.transform.Rotation.from_matrix(axes.T @ cycle_rotation.T @ axes).as_quat()
        return (placed - offset) @ axes / unit, multiply_quaternions(back, normalised(rotations))

    def _to_map(self, translations: Array, rotations: Array) -> tuple[Array, Array]:
        """Positions (N, J, 3) in ``map`` and rotations from rest (N, J, 3, 3) of local poses."""
        world = self.motion.compose_world(translations, rotations)
        positions = world[..., :3, 3] @ (self.frame.unit * self._map_from_file).T + self._translation
        from_rest = self._map_from_file @ world[..., :3, :3] @ self.frame.rest_from_body @ WORLD_FROM_BODY.T
        return positions, from_rest

    def _mirrored(self, positions: Array, rotations: Array) -> tuple[Array, Array]:
        """Swap left and right of positions (N, J, 3) and rotations (N, J, 3, 3)."""
        yaw = yaw_matrices(self.placement.yaw)
        at_rest = np.diag([1.0, -1.0, 1.0])  # rotations are relative to a body that faces +x
        mirror = yaw @ at_rest @ yaw.T
        center = np.array([*self.placement.position, 0.0])
        pairs = self._opposite_joints
        return (positions[:, pairs] - center) @ mirror + center, mirror @ rotations[:, pairs] @ at_rest

    @cached_property
    def _opposite_joints(self) -> Indices:
        return opposite_joints(self.names, self.match.roles)

    @cached_property
    def _cycle_step(self) -> tuple[float, Array]:
        """Yaw and translation (3,) on the floor from the start of a cycle to its end."""
        # a rest frame at the start does not show where the person starts
        start = max(self.start, self.steady_frames[0] * self.motion.frame_time) if self.jumps else self.start
        positions, rotations = self._to_map(
            *self._local_poses(np.array([start, self.start + self.cycle_length]))
        )
        root = self.match.roles["Hips"]
        change = rotations[1, root] @ rotations[0, root].T
        yaw = float(np.arctan2(change[1, 0] - change[0, 1], change[0, 0] + change[1, 1]))
        return yaw, (positions[1, root] - yaw_matrices(yaw) @ positions[0, root]) * (1, 1, 0)

    def _cycle_transforms(self, cycles: Array) -> tuple[Array, Array]:
        """Rotations (N, 3, 3) and translations (N, 3) on the floor, from the first cycle to each cycle."""
        yaw, step = self._cycle_step
        rotations = yaw_matrices(yaw * cycles)
        if abs(yaw) < 1e-9:
            return rotations, cycles[:, None] * step
        # every cycle rotates about the fixed point of the first step
        fixed = np.zeros(3)
        fixed[:2] = np.linalg.solve(np.eye(2) - yaw_matrices(yaw)[:2, :2], step[:2])
        return rotations, fixed - rotations @ fixed


def to_world(
    motion: Motion,
    table: str | None = None,
    unit: float | None = None,
    up: str | None = None,
    facing: str | None = None,
    min_confidence: float | None = None,
    **options: Any,
) -> WorldMotion:
    """Place a motion in ``map``. Joints and file frame are detected where they are not given.

    Args:
        motion: Motion of a person.
        table: Joint table: name of a built-in table, or YAML file.
        unit: Metres per file unit.
        up: File axis that points up.
        facing: File axis that the person faces at rest.
        min_confidence: Lowest confidence of the joint match. If None, 0.12.
        options: Other fields of :class:`WorldMotion`. By default, ``loop`` is ``none``.

    Raises:
        MotionError: The motion is not that of a person, or a given value does not fit the motion.
    """
    match = match_motion(motion, table, min_confidence)
    frame = detect_file_frame(motion, match, unit, up, facing)
    return WorldMotion(motion, match, frame, **{"loop": "none", **options})


def floor_height(lowest: Array) -> float:
    """Height of the floor under a motion, from the height of its lowest point in each frame (F,). In most
    frames a foot is on the floor. Only few frames have toes below it (at push-off), or a person in the
    air."""
    return float(np.percentile(lowest, 33))


def yaw_matrices(yaws: ArrayLike) -> Array:
    """Rotations (..., 3, 3) about the vertical axis by angles (...), radians."""
    out = np.zeros((*np.shape(yaws), 3, 3))
    out[..., 0, 0] = out[..., 1, 1] = np.cos(yaws)
    out[..., 1, 0] = np.sin(yaws)
    out[..., 0, 1] = -out[..., 1, 0]
    out[..., 2, 2] = 1.0
    return out


#: A message lists at most this number of jumps.
_MAX_LISTED = 3
#: A knee bends backwards if it is behind the line from hip to ankle by at least this share of the length of
#: the line.
_BACKWARDS = 0.05
#: The trunk is horizontal if the cosine of its angle with the vertical is below this value.
_LYING = 0.5
#: Knees or trunk get a warning if they are wrong in at least this share of the frames.
_MOST = 0.5


def playing_warnings(world: WorldMotion) -> list[str]:
    """Warnings for the user of a scene: a low confidence, an unlikely frame rate, rest frames and jumps."""
    pace = pace_warning(world.motion, world.match.roles, world.frame, world.speed)
    warnings = [each for each in (world.match.warning, world.frame.warning, pace) if each is not None]
    jumps = list(world.jumps)
    frame_time = world.motion.frame_time
    if rest := leading_rest(world.motion, jumps):
        first = jumps.pop(0)
        frames = "frame 0 is a rest pose" if rest == 1 else f"frames 0 to {rest - 1} are a rest pose"
        remedy = f": start: {rest * frame_time:.9g} leaves it out" if rest < world.motion.n_frames - 1 else ""
        warnings.append(f"{frames}, {_metres(first.distance)} away from frame {rest}{remedy}")
    if jumps:
        texts = (f"{_metres(jump.distance)} to frame {jump.frame}" for jump in jumps)
        listed = some_of(texts, _MAX_LISTED, rest=", and {} more times")
        warnings.append(f"the person jumps {listed}: play a part without jumps (start, end)")
    return warnings


def posture_warnings(world: WorldMotion, poses: JointPoses) -> list[str]:
    """Warn if the file seems damaged or its up axis wrong: in most frames a knee bends backwards, or the
    trunk is horizontal."""
    roles, points = world.match.roles, poses.positions
    lines = BodyLines.of(points, roles)
    backwards = np.zeros(len(points), dtype=bool)
    for side in ("Left", "Right"):
        if f"{side}Ankle" in roles:
            hip, knee, ankle = (points[:, roles[side + part]] for part in ("Hip", "Knee", "Ankle"))
            line = hip - ankle
            in_front = ((knee - ankle) * unit_vectors(np.cross(lines.hips, line))).sum(1)
            backwards |= in_front < -_BACKWARDS * np.maximum(np.linalg.norm(line, axis=1), 1e-9)
    warnings = []
    if (share := float(backwards.mean())) > _MOST:
        warnings.append(
            f"a knee bends backwards in {share:.0%} of the frames: left and right are exchanged, or the "
            "file is damaged"
        )
    if {"LeftShoulder", "RightShoulder"} <= roles.keys():
        lies = unit_vectors(lines.trunk)[:, 2] < _LYING
        if (share := float(lies.mean())) > _MOST and world.motion.up is None:
            warnings.append(
                f"the trunk lies in {share:.0%} of the frames, with {world.frame.up} up: if the person does "
                "not lie, give the up axis of the file (up), or the file is damaged"
            )
    return warnings


def _metres(distance: float) -> str:
    return f"{distance:.2f} m" if distance < 10 else f"{distance:.4g} m"


#: Fewest and most frames that are examined, from the middle of a motion.
_EXAMINED = 8, 2000
#: A hand or a foot moves if its spread about its mean place relative to the hips is larger than the first
#: value (RMS, metres). A person walks if the hips move farther than the second value (metres).
_MOVES, _WALKS = 0.04, 1.0
#: Joints that show how a limb moves, the best first.
_LEG, _ARM = ("Ankle", "Knee"), ("Wrist", "Elbow")
#: Largest acceleration of hands and feet (RMS, m/s^2). Sprints reach 90, dances 20, walks 5 to 13.
_MOST_ACCELERATION = 120.0
#: Lowest plausible frequency (Hz) of the fastest movement, for people who walk and for others. Usual are 1.7
#: to 3 Hz and 0.4 to 5 Hz.
_LEAST_FREQUENCY = {True: 0.15, False: 0.03}
#: Usual frequency (Hz) of the feet of a person who walks, and of the hands and feet of other people.
_USUAL_FREQUENCY = {True: 1.05, False: 0.45}
#: Usual frame rates of files.
_RATES = (24.0, 25.0, 30.0, 50.0, 60.0, 100.0, 120.0, 240.0)
_OFTEN = (30.0, 60.0, 120.0)


def pace_warning(motion: Motion, roles: Mapping[str, int], frame: FileFrame, speed: float) -> str | None:
    """Warn about a frame rate with which a person is too fast or too slow, and name a likely rate.

    Feet of people who walk go back and forth about once a second, whatever their speed. A rate that is wrong
    by a factor of less than three or four remains plausible, and the result is None.

    Args:
        motion: Motion of a file.
        roles: Role -> joint.
        frame: Coordinate frame of the file.
        speed: Seconds of the file per second.
    """
    ends = ([f"{side}{part}" for part in limb] for limb in (_LEG, _ARM) for side in ("Left", "Right"))
    limbs = [next(role for role in end if role in roles) for end in ends if roles.keys() & {*end}]
    joints = [roles[role] for role in ("LeftHip", "RightHip", *limbs)]
    start = max(0, (motion.n_frames - _EXAMINED[1]) // 2)
    places = frame.unit * motion.world_positions(slice(start, start + _EXAMINED[1]))[:, joints]
    if len(places) < _EXAMINED[0]:
        return None
    hips = places[:, :2].mean(1)
    beside = places[:, 2:] - hips[:, None]
    spread = np.sqrt(((beside - beside.mean(0)) ** 2).sum(-1).mean(0))
    moving = spread > _MOVES
    if not moving.any():
        return None
    rate = speed / motion.frame_time
    speeds = rate * np.linalg.norm(np.diff(beside[:, moving], axis=0), axis=-1)
    spread = spread[moving]
    # single wrong frames must not count
    usual = np.sqrt((np.minimum(speeds, np.quantile(speeds, 0.95, axis=0)) ** 2).mean(0))
    turns = 2 * np.pi * spread
    walks = bool(np.linalg.norm(np.ptp(hips, axis=0)) > _WALKS)
    feet = np.array([role.endswith(_LEG) for role in limbs])[moving]
    which = feet if walks and feet.any() else np.ones_like(feet)
    too_slow = float((np.quantile(speeds, 0.999, axis=0) / turns)[which].max()) < _LEAST_FREQUENCY[walks]
    if not too_slow and float((usual**2 / spread)[which].min()) < _MOST_ACCELERATION:
        return None
    measured = rate * _USUAL_FREQUENCY[walks] / float(np.median((usual / turns)[which]))
    # some files store the rate instead of the time, or the time in milliseconds
    stated = (motion.frame_time, 1000 / motion.frame_time)
    meant = [each for each in _RATES if np.abs(np.divide(stated, each) - 1).min() < 0.01] or _RATES
    likely = min(meant, key=lambda each: abs(np.log(each / measured)) + 0.15 * (each not in _OFTEN))
    way = float(np.linalg.norm(np.diff(hips, axis=0), axis=-1).mean()) * rate
    return (
        f"the person moves at {way:.3g} m/s, with hands and feet at up to {speeds.max():.3g} m/s: too "
        f"{'slow' if too_slow else 'fast'}. The frame rate, {rate:.6g} frames per second, is hardly right; "
        f"{likely:g} are likely (speed: {likely * motion.frame_time:.4g})"
    )
