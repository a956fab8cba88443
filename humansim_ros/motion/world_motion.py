"""A motion put into the world: up axis, facing and unit found, turned into ``map`` in metres, sampled at any
time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from humansim_ros.errors import MotionError
from humansim_ros.motion.bvh import Motion
from humansim_ros.motion.joint_tables import JointMatch, other_side
from humansim_ros.rotations import WORLD_FROM_BODY, matrix_to_quaternion, quaternion_to_matrix, slerp
from humansim_ros.types import Array

Loop = Literal["none", "repeat", "continue"]
Anchor = Literal["start", "center", "file"]

#: Metres per file unit of the units that motion files are written in ("cmu" is 1/0.45 inch).
UNITS = {"m": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "inch": 0.0254, "foot": 0.3048, "cmu": 0.0254 / 0.45}
#: Ankle height, which no joint link measures, as a fraction of ankle-to-head height.
_ANKLE_SHARE = 0.06
_PLAUSIBLE_STATURE = (1.2, 2.1)
_TYPICAL_STATURE = 1.7
#: What a format's own unit is believed between, metres.
_CHILD, _GIANT = 0.4, 2.6
#: A pose stands if the straight way from ankles to head is at least this part of the way along the links.
_STRAIGHT = 0.7
#: Poses that are nearly as straight as the straightest: this part of it at least.
_NEARLY = 0.97
#: Half the span of the differences that velocities are, seconds.
VELOCITY_STEP = 1e-3


@dataclass(frozen=True)
class JointPoses:
    """Joints at N instants: ``positions`` (N, J, 3) and ``rotations`` (N, J, 4) xyzw.

    In ``map``, metres. A rotation is the joint's turn from the motion's rest pose with the person standing
    there facing +x: at rest every rotation is the identity. ``linear`` (m/s) and ``angular`` (rad/s)
    velocities (N, J, 3) in ``map``, or None where a source does not give them.
    """

    names: tuple[str, ...]
    positions: Array
    rotations: Array
    linear: Array | None = None
    angular: Array | None = None

    def moved(self, seconds: ArrayLike) -> JointPoses:
        """The joints of one instant (N = 1) some short times (M,) before and after it, as they move."""
        if self.linear is None or self.angular is None:
            raise MotionError("these joints have no velocities")
        steps = np.asarray(seconds, dtype=float)[:, None, None]
        positions = self.positions + self.linear * steps
        turn = Rotation.from_rotvec((self.angular * steps).reshape(-1, 3))
        rotations = np.broadcast_to(self.rotations, (*positions.shape[:-1], 4)).reshape(-1, 4)
        turned = (turn * Rotation.from_quat(rotations)).as_quat()
        return JointPoses(self.names, positions, turned.reshape(*positions.shape[:-1], 4))


def central_difference(
    before: Array, after: Array, rotation_before: Array, rotation_after: Array, seconds: float | Array
) -> tuple[Array, Array]:
    """Linear and angular velocity (..., 3) from positions (..., 3) and quaternions (..., 4) ``seconds``
    apart.
    """
    turn = (
        Rotation.from_quat(rotation_after.reshape(-1, 4))
        * Rotation.from_quat(rotation_before.reshape(-1, 4)).inv()
    )
    return (after - before) / seconds, turn.as_rotvec().reshape(before.shape) / seconds


@dataclass(frozen=True, eq=False)
class Velocity:
    """How something moves: ``linear`` (3,) m/s and ``angular`` (3,) rad/s, in the axes of ``map``."""

    linear: Array
    angular: Array

    @classmethod
    def between(cls, positions: Array, rotations: Array, seconds: float) -> Velocity:
        """From positions (2, 3) and quaternions (2, 4) so many seconds apart."""
        (before, after), turns = positions, rotations
        return cls(*central_difference(before, after, turns[0], turns[1], max(seconds, 1e-12)))

    def paced(self, pace: float) -> Velocity:
        """The same so many times as fast."""
        return self if pace == 1 else Velocity(self.linear * pace, self.angular * pace)


@dataclass(frozen=True)
class Placement:
    """Where a motion goes in the world: its anchor is put at ``position`` (x, y), turned by ``yaw`` radians.

    ``anchor``: ``start`` is the root's place in the first frame, ``center`` the middle of the ground it
    covers, ``file`` the file's own origin.
    """

    position: tuple[float, float] = (0.0, 0.0)
    yaw: float = 0.0
    anchor: Anchor = "start"


@dataclass(frozen=True)
class FileFrame:
    """How a file's space lies in the world: found from skeleton and data by :func:`detect_file_frame`.

    ``up``: file axis that points up ("x", "y", "z", or "-y" where y points down). ``unit``: metres per file
    unit, ``unit_name``: its name, or "unknown" where no known unit gives a person's height and 1.7 m is
    assumed. ``world_from_file`` (3, 3): rotation with the rest pose's facing on +x. ``rest_from_body``: body
    axes in the file's rest pose (3, 3), or in each joint's own axes (J, 3, 3) where the OFFSETs make no
    standing person and the straightest frame counts as the rest pose. ``ankle_to_head``: file units.
    """

    up: str
    unit: float
    unit_name: str
    world_from_file: Array
    rest_from_body: Array
    ankle_to_head: float

    @property
    def facing(self) -> str:
        """File axis nearest to where the person faces at rest."""
        return axis_name(self.world_from_file[0])

    @property
    def rest_stands(self) -> bool:
        """Whether the OFFSETs themselves are a standing person."""
        return self.rest_from_body.ndim == 2

    @property
    def stature(self) -> float:
        """Estimated standing height of the recorded person, metres."""
        return self.ankle_to_head * (1 + _ANKLE_SHARE) * self.unit


def detect_file_frame(
    motion: Motion,
    match: JointMatch,
    unit: float | None = None,
    up: str | None = None,
    facing: str | None = None,
) -> FileFrame:
    """Find up axis, facing and unit of a motion whose joints are known.

    Up is where the head is seen from the feet most of the time; facing is what lies ahead of hips and
    shoulders at rest; the unit is the known one that makes the person nearest to 1.7 m. Each can be said
    where it is known: ``unit`` in metres per file unit, ``up`` and ``facing`` as file axes ("y", "-z").
    Raises MotionError for a skeleton without height, or hips at one place.
    """
    roles = match.roles
    rest = motion.rest_positions()
    transforms = motion.world_transforms(np.unique(np.linspace(0, motion.n_frames - 1, 120).astype(int)))
    frames = transforms[..., :3, 3]
    head = roles.get("Head", roles.get("Neck", roles["Hips"]))
    ankles = [roles.get(f"{side}Ankle", roles[f"{side}Knee"]) for side in ("Left", "Right")]

    seen = _main_direction((frames[:, head] - frames[:, ankles].mean(1)).mean(0))
    upward = seen if up is None else axis_vector(up)
    height = ankle_to_head(rest, motion.parents, match)
    if height <= 0:
        raise MotionError("the skeleton has no height: all its OFFSETs are zero", path=motion.path)
    stretch = rest[head] - rest[ankles].mean(0)
    if np.linalg.norm(stretch) > _STRAIGHT * height:
        rest_up = _main_direction(stretch)
        if (rest_up == seen).all():
            # the rest pose stands as the person does
            rest_axes = axes = _body_axes(rest, roles, upward, motion, facing)
        else:
            # a rest pose that lies down in file space is stood up by the root: face as in the first frame
            rest_axes = _body_axes(rest, roles, rest_up, motion)
            axes = _body_axes(frames[0], roles, upward, motion, facing)
    else:
        # the OFFSETs are no standing person (all bones along one axis, say): the straightest frame is, or of
        # those that are nearly as straight, the one with its feet flattest on the floor
        straight = np.linalg.norm(frames[:, head] - frames[:, ankles].mean(1), axis=-1)
        tiptoe = (frames[:, ankles] @ upward).sum(1) - 2 * (frames @ upward).min(1)
        straightest = int(np.argmin(np.where(straight > _NEARLY * straight.max(), tiptoe, np.inf)))
        axes = _body_axes(frames[straightest], roles, upward, motion, facing)
        rest_axes = np.swapaxes(transforms[straightest, :, :3, :3], -1, -2) @ axes
    stature = height * (1 + _ANKLE_SHARE)
    if unit is None and motion.unit is not None and _CHILD <= stature * motion.unit <= _GIANT:
        unit_name, unit = "as the format has it", motion.unit
    elif unit is None:
        unit_name, unit = _guess_unit(stature)
    else:
        unit_name = "given"
    return FileFrame(
        up=axis_name(axes[:, 1]),
        unit=unit,
        unit_name=unit_name,
        world_from_file=WORLD_FROM_BODY @ axes.T,
        rest_from_body=rest_axes,
        ankle_to_head=height,
    )


def axis_vector(name: str) -> Array:
    """Unit vector (3,) of an axis by name: "x", "y", "z", "+y", "-z"."""
    plain = name.strip().lower().removeprefix("+")
    axis = plain.removeprefix("-")
    if axis not in ("x", "y", "z") or len(plain) > 2:
        raise MotionError(f"{name!r} is no axis: say x, y, z, -x, -y or -z")
    return np.eye(3)["xyz".index(axis)] * (-1.0 if plain.startswith("-") else 1.0)


def axis_name(direction: Array) -> str:
    """Name of the axis that a direction (3,) is nearest to, "-z" style."""
    axis = int(np.argmax(np.abs(direction)))
    return ("-" if direction[axis] < 0 else "") + "xyz"[axis]


def ankle_to_head(positions: Array, parents: Sequence[int] | NDArray[np.intp], match: JointMatch) -> float:
    """Ankle-to-head height of a motion's skeleton (thesis 7.2), along its links so that no pose changes it.

    ``positions``: (J, 3) of any pose.
    """
    roles = match.roles

    def length(a: int, b: int) -> float:
        return float(np.linalg.norm(positions[a] - positions[b]))

    legs = [
        length(roles[f"{side}Hip"], roles[f"{side}Knee"])
        + (length(roles[f"{side}Knee"], roles[f"{side}Ankle"]) if f"{side}Ankle" in roles else 0.0)
        for side in ("Left", "Right")
    ]
    top = roles.get("Head", roles.get("Neck", roles["Hips"]))
    head_link = match.parallel.get("vt3")
    trunk = length(*head_link) if head_link else _farthest_child(positions, parents, top)
    while parents[top] >= 0 and top != roles["Hips"]:
        trunk += length(top, int(parents[top]))
        top = int(parents[top])
    hips = (positions[roles["LeftHip"]] + positions[roles["RightHip"]]) / 2
    return sum(legs) / 2 + trunk + float(np.linalg.norm(positions[roles["Hips"]] - hips))


def _farthest_child(positions: Array, parents: Sequence[int] | NDArray[np.intp], joint: int) -> float:
    children = np.flatnonzero(np.asarray(parents) == joint)
    return float(np.linalg.norm(positions[children] - positions[joint], axis=1).max(initial=0.0))


def _main_direction(direction: Array) -> Array:
    """The file axis (3,), or its opposite, that a direction is nearest to."""
    axis = int(np.argmax(np.abs(direction)))
    return np.eye(3)[axis] * np.sign(direction[axis])


def _body_axes(
    positions: Array, roles: Mapping[str, int], up: Array, motion: Motion, facing: str | None = None
) -> Array:
    """Body axes (left, up, forward as columns) in file space, of a person in a pose (J, 3); snapped to file
    axes.
    """
    if facing is not None:
        forward = axis_vector(facing)
        if forward @ up:
            raise MotionError(f"a person cannot face {facing} where {axis_name(up)} is up", path=motion.path)
        return np.stack([np.cross(up, forward), up, forward], axis=1)
    left = sum(
        positions[roles[f"Left{part}"]] - positions[roles[f"Right{part}"]]
        for part in ("Hip", "Shoulder")
        if f"Left{part}" in roles and f"Right{part}" in roles
    )
    left = np.asarray(left, dtype=float) * (up == 0)
    if np.linalg.norm(left) < 1e-9:
        raise MotionError(
            "left and right hips are at the same place: cannot tell where the person faces", path=motion.path
        )
    left /= np.linalg.norm(left)
    axis = _main_direction(left)
    if axis @ left > np.cos(np.radians(25)):
        left = axis
    return np.stack([left, up, np.cross(left, up)], axis=1)


def _guess_unit(stature: float) -> tuple[str, float]:
    low, high = _PLAUSIBLE_STATURE
    plausible = [(name, unit) for name, unit in UNITS.items() if low <= stature * unit <= high]
    if not plausible:
        return "unknown", _TYPICAL_STATURE / stature
    return min(plausible, key=lambda named: abs(stature * named[1] - _TYPICAL_STATURE))


def floor_height(lowest: Array) -> float:
    """Height of the floor under a motion, from the height of its lowest point in each frame (F,).

    In most frames some foot stands on the floor; toes that dip below it at push-off, and jumps, are few.
    """
    return float(np.percentile(lowest, 33))


class CleanUp(Protocol):
    """What may change poses after they are placed, such as feet that are pinned to the floor."""

    def apply(self, poses: JointPoses, phases: Array, turns: Array) -> JointPoses:
        """Changed poses. ``phases`` (N,): seconds of motion since its ``start``, ``turns`` (N, 3, 3): the
        turn of the loop's round that each is in.
        """
        ...


@dataclass(frozen=True)
class WorldMotion:
    """A motion in the world: ``map`` frame, metres, lowest joint on the floor, placed, cut, looped.

    ``loop``: ``none`` holds the last frame, ``repeat`` jumps back to the first, ``continue`` carries position
    and heading on, so that a walk cycle walks on. ``start``, ``end``: the part of the file that plays,
    seconds of the file (``end`` None: to its end). ``speed``: seconds of the file per second. ``blend``:
    seconds of the file over which the end of a round fades into the start of the next; a round is that much
    shorter. ``mirror``: left and right change sides, about the vertical plane through the placement along
    its heading. Raises MotionError if these contradict each other.
    """

    motion: Motion
    match: JointMatch
    frame: FileFrame
    placement: Placement = Placement()
    loop: Loop = "repeat"
    start: float = 0.0
    end: float | None = None
    speed: float = 1.0
    blend: float = 0.0
    mirror: bool = False
    clean_up: CleanUp | None = None

    def __post_init__(self) -> None:
        duration = self.motion.duration
        end = self._end
        problem = ""
        if not 0 <= self.start <= duration:
            problem = f"start is {self.start:g} s, outside the motion's 0 to {duration:g} s"
        elif not self.start < end + (duration == 0):
            problem = f"end ({end:g} s) must come after start ({self.start:g} s)"
        elif not 0 <= self.speed < np.inf:
            problem = f"speed must be 0 or more, not {self.speed:g}"
        elif not 0 <= self.blend <= (end - self.start) / 2:
            problem = f"blend ({self.blend:g} s) must be at most half of what plays ({end - self.start:g} s)"
        if problem:
            raise MotionError(problem, path=self.motion.path)

    @property
    def names(self) -> tuple[str, ...]:
        return self.motion.joint_names

    @property
    def _end(self) -> float:
        """End of what plays, seconds of the file; an ``end`` behind the last frame is the last frame."""
        return self.motion.duration if self.end is None else min(self.end, self.motion.duration)

    @property
    def round_length(self) -> float:
        """Seconds of the file in a round."""
        return self._end - self.start - (self.blend if self.loop != "none" else 0.0)

    @property
    def duration(self) -> float:
        """Seconds that a round takes at this speed; infinite at speed 0."""
        return self.round_length / self.speed if self.speed else np.inf

    @property
    def frame_times(self) -> Array:
        """Seconds (N,) since ``start`` of the file's frames in a round, in seconds of the file."""
        step = self.motion.frame_time
        first = int(np.ceil(self.start / step - 1e-6))
        last = int(np.floor((self.start + self.round_length) / step + 1e-6))
        return np.maximum(np.arange(first, max(first, last) + 1) * step - self.start, 0.0)

    @cached_property
    def _rotations(self) -> Array:
        return self.motion.local_rotations()

    @cached_property
    def _translations(self) -> Array:
        return self.motion.local_translations()

    @cached_property
    def _axes(self) -> Array:
        """World from file with yaw (3, 3)."""
        return _yaw_matrix(self.placement.yaw) @ self.frame.world_from_file

    @cached_property
    def _offset(self) -> Array:
        """Translation (3,) that puts the anchor in its place and the feet on the floor."""
        step = self.motion.frame_time
        first, last = (int(np.floor(t / step + 1e-6)) for t in (self.start, self._end))
        frames = slice(first, last + 1, max(1, (last - first) // 500))
        points = self.motion.world_positions(frames) @ (self.frame.unit * self._axes).T
        root = points[:, self.match.roles["Hips"], :2]
        at = {"start": root[0], "center": (root.min(0) + root.max(0)) / 2, "file": np.zeros(2)}[
            self.placement.anchor
        ]
        floor = floor_height(points[..., 2].min(1))
        return np.array([*(np.array(self.placement.position) - at), -floor])

    def _local(self, times: Array) -> tuple[Array, Array]:
        """Local translations (N, J, 3) and rotations (N, J, 4) at file times: slerp between frames."""
        last = self.motion.n_frames - 1
        place = np.clip(times / self.motion.frame_time, 0, last)
        # a time that is a frame but for rounding is that frame
        place = np.where(np.abs(place - np.round(place)) < 1e-6, np.round(place), place)
        before = np.floor(place).astype(int)
        after = np.minimum(before + 1, last)
        fraction = (place - before)[:, None]
        rotations = slerp(self._rotations[before], self._rotations[after], fraction)
        start, end = self._translations[before], self._translations[after]
        return start + fraction[..., None] * (end - start), rotations

    def _placed(self, translations: Array, rotations: Array) -> tuple[Array, Array]:
        """Joint positions (N, J, 3) in ``map`` and turns from rest (N, J, 3, 3) of local poses."""
        world = self.motion.compose_world(translations, quaternion_to_matrix(rotations))
        positions = world[..., :3, 3] @ (self.frame.unit * self._axes).T + self._offset
        turn = self._axes @ world[..., :3, :3] @ self.frame.rest_from_body @ WORLD_FROM_BODY.T
        return positions, turn

    def _blended(self, phases: Array, rounds: Array) -> tuple[Array, Array]:
        """Local poses of a phase (N,) of the round; the start of a later round is still fading from the end
        of the one before.
        """
        translations, rotations = self._local(self.start + phases)
        if self.blend == 0 or self.loop == "none":
            return translations, rotations
        fading = np.flatnonzero((rounds != 0) & (phases < self.blend))
        if len(fading):
            t, r = self._local(self.start + self.round_length + phases[fading])
            roots = np.flatnonzero(self.motion.parents < 0)
            t[:, roots], r[:, roots] = self._brought_back(t[:, roots], r[:, roots])
            part = phases[fading] / self.blend
            part = (part * part * (3 - 2 * part))[:, None]
            translations[fading] = t + part[..., None] * (translations[fading] - t)
            rotations[fading] = slerp(r, rotations[fading], part)
        return translations, rotations

    def _brought_back(self, translations: Array, rotations: Array) -> tuple[Array, Array]:
        """Root joints' local poses, in the file, carried back by a round of ``continue``."""
        if self.loop != "continue":
            return translations, rotations
        carry_r, carry_t = (part[0] for part in self._carried(np.ones(1)))
        unit, axes, offset = self.frame.unit, self._axes, self._offset
        placed = (unit * translations @ axes.T + offset - carry_t) @ carry_r
        turn = Rotation.from_matrix(axes.T @ carry_r.T @ axes)
        turned = (turn * Rotation.from_quat(rotations.reshape(-1, 4))).as_quat().reshape(rotations.shape)
        return (placed - offset) @ axes / unit, turned

    def played(self, times: ArrayLike, ahead: float = 0.0) -> Array:
        """Seconds of the file (N,) that have played at N times, over all rounds; ``ahead`` of them before."""
        return np.atleast_1d(np.asarray(times, dtype=float)) * self.speed + ahead

    def sample(self, times: ArrayLike, ahead: float = 0.0) -> JointPoses:
        """Joints at N times in seconds from the motion's start: slerp between frames, then kinematics.

        ``ahead``: seconds of the file that it is ahead by, so that it can go on at another speed from where
        it is.
        """
        t = self.played(times, ahead)
        return self._sample(t, self._rounds(t))

    def sample_moving(self, times: ArrayLike, ahead: float = 0.0) -> JointPoses:
        """:meth:`sample` with velocities: central differences over two milliseconds.

        Where the motion jumps back to its start or stands still after its end, they reach no farther.
        """
        t = self.played(times, ahead)
        rounds = self._rounds(t)
        step = VELOCITY_STEP * max(self.speed, 1e-6)
        early, late = t - step, t + step
        if self.loop == "continue" or (self.loop == "repeat" and self.blend > 0):
            # the first round does not fade in from one before it
            early = np.where(rounds == 0, np.maximum(early, 0.0), early)
            all_rounds = np.concatenate([self._rounds(early), rounds, self._rounds(late)])
        else:
            start, end = rounds * self.round_length, (rounds + 1) * self.round_length
            early, late = np.clip(early, start, end), np.clip(late, start, end)
            all_rounds = np.tile(rounds, 3)
        poses = self._sample(np.concatenate([early, t, late]), all_rounds)
        before, positions, after = np.split(poses.positions, 3)
        turn_before, rotations, turn_after = np.split(poses.rotations, 3)
        seconds = np.maximum(late - early, 1e-12)[:, None, None]
        linear, angular = central_difference(before, after, turn_before, turn_after, seconds)
        return JointPoses(self.names, positions, rotations, linear * self.speed, angular * self.speed)

    def _rounds(self, times: Array) -> Array:
        """Which round of the loop each time (N,), seconds of the file, is in."""
        if self.loop == "none" or self.round_length <= 0:
            return np.zeros_like(times)
        return np.floor(times / self.round_length + 1e-9)

    def _sample(self, times: Array, rounds: Array) -> JointPoses:
        length = self.round_length
        phases = np.clip(times - rounds * length, 0, length)
        positions, turn = self._placed(*self._blended(phases, rounds))
        if self.loop == "continue" and length > 0:
            carry_r, carry_t = self._carried(rounds)
            positions = np.einsum("nij,nkj->nki", carry_r, positions) + carry_t[:, None]
            turn = carry_r[:, None] @ turn
        if self.mirror:
            positions, turn = self._mirrored(positions, turn)
        poses = JointPoses(self.names, positions, matrix_to_quaternion(turn))
        if self.clean_up is None:
            return poses
        return self.clean_up.apply(poses, phases, self.round_turns(rounds))

    def round_turns(self, rounds: Array) -> Array:
        """Rotations (N, 3, 3) about the vertical that carry the first round to each of ``rounds`` (N,)."""
        if self.loop != "continue" or self.round_length <= 0:
            return np.broadcast_to(np.eye(3), (len(rounds), 3, 3))
        carry_r, _ = self._carried(rounds)
        return np.swapaxes(carry_r, -1, -2) if self.mirror else carry_r  # mirrored: the other way round

    def _mirrored(self, positions: Array, turn: Array) -> tuple[Array, Array]:
        """Positions (N, J, 3) and turns (N, J, 3, 3) with the sides changed."""
        yaw = _yaw_matrix(self.placement.yaw)
        mirror = yaw @ np.diag([1.0, -1.0, 1.0]) @ yaw.T
        through = np.array([*self.placement.position, 0.0])
        pairs = self._pairs
        return (positions[:, pairs] - through) @ mirror + through, mirror @ turn[:, pairs] @ mirror

    @cached_property
    def _pairs(self) -> NDArray[np.intp]:
        """Each joint's counterpart on the other side (J,); its own index where it has none."""
        return opposite_joints(self.names, self.match.roles)

    @cached_property
    def _step(self) -> tuple[float, Array]:
        """Turn about z and translation (3,) of the floor plane that carry a round's start to its end."""
        positions, turn = self._placed(*self._local(self.start + np.array([0.0, self.round_length])))
        root = self.match.roles["Hips"]
        change = turn[1, root] @ turn[0, root].T
        yaw = float(np.arctan2(change[1, 0] - change[0, 1], change[0, 0] + change[1, 1]))
        return yaw, (positions[1, root] - _yaw_matrix(yaw) @ positions[0, root]) * (1, 1, 0)

    def _carried(self, rounds: Array) -> tuple[Array, Array]:
        """Rotation (N, 3, 3) and translation (N, 3) of the floor plane that carry the first round to each."""
        yaw, step = self._step
        carry_r = np.stack([_yaw_matrix(yaw * n) for n in rounds])
        if abs(yaw) < 1e-9:
            return carry_r, rounds[:, None] * step
        # the fixed point of a plane rotation: every round turns about it
        fixed = np.zeros(3)
        fixed[:2] = np.linalg.solve(np.eye(2) - _yaw_matrix(yaw)[:2, :2], step[:2])
        return carry_r, fixed - carry_r @ fixed


def opposite_joints(names: Sequence[str], roles: Mapping[str, int]) -> NDArray[np.intp]:
    """Index (J,) of each joint's counterpart on the other side, by role and by name; its own where it has
    none.
    """
    pairs = np.arange(len(names))
    index = {name: number for number, name in enumerate(names)}
    lower = {name.lower(): number for name, number in index.items()}
    for number, name in enumerate(names):
        other = other_side(name)
        if other is not None and other.lower() in lower:
            pairs[number], pairs[lower[other.lower()]] = lower[other.lower()], number
    for role, joint in roles.items():
        if role.startswith("Left") and (twin := roles.get(f"Right{role[4:]}")) is not None:
            pairs[joint], pairs[twin] = twin, joint
    # a pair that is not one in both directions is none
    return np.where(pairs[pairs] == np.arange(len(names)), pairs, np.arange(len(names)))


def _yaw_matrix(yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
