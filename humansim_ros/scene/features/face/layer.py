"""Faces over time: how keys, files, and blinks and glances change the actions of a face and its gaze.

A face depends only on the scene time and on a seed. The joints of a motion carry the face: extra joints come
after the other joints. The angle of ``face/<action>`` about x, in radians, is the weight of the action.
``face/gaze`` is at the point that the eyes look at. Its angle is the share of the gaze, from 0 (the actions
decide where the eyes look) to 1. ``face/head`` is at the point that the head turns to. The head is slower
than the eyes. Its angle is the share of that turn.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import ClassVar

import numpy as np

from humansim_ros.errors import MotionError, unknown
from humansim_ros.files.reading import read_table
from humansim_ros.geometry import AROUND, VELOCITY_STEP, angle_between, smooth_step, unit_vectors
from humansim_ros.motion.body import (
    ACTIONS,
    FACE_AT_REST,
    LOOKS,
    Eyes,
    Jaw,
    JointPoses,
    Rated,
    both_sides,
    expression,
    face_weights,
    looked_angles,
    with_looks,
    within_limits,
)
from humansim_ros.motion.pose import PoseStage
from humansim_ros.people.humans import Human
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.layers import BodyPoses, PoseLayer
from humansim_ros.scene.core.looks import RandomNumbers
from humansim_ros.scene.core.world import World
from humansim_ros.scene.features.face import FaceKeyConfig
from humansim_ros.types import Array

#: Names of joints that carry a face in a motion begin with this text.
FACE_JOINT = "face/"
GAZE_JOINT = FACE_JOINT + "gaze"
HEAD_JOINT = FACE_JOINT + "head"
FACE_JOINTS = frozenset((*(FACE_JOINT + action for action in ACTIONS), GAZE_JOINT, HEAD_JOINT))
#: Target of a gaze: a point in ``map``, or the name of a human or camera.
GazeTarget = str | tuple[float, float, float]
#: Seconds after which blinks and glances repeat.
LIFE_SECONDS = 600.0
#: Blinks of a person at rest: number a minute [Bentivoglio 1997], spread of the logarithm of the intervals
#: between blinks, and the shortest interval in seconds.
_BLINKS, _SPREAD, _SHORTEST = 17.0, 0.7, 0.6
#: Course of a blink [VanderWerf 2003]: seconds, and how far the lids are closed.
_BLINK = ((0.0, 0.0), (0.1, 1.0), (0.12, 1.0), (0.35, 0.0))
#: Duration of saccades: 21 ms, and 2.2 ms more for each degree [Carpenter 1988].
_SACCADE, _SACCADE_DEGREE = 0.021, 0.0022
#: Duration of turns of the head: seconds, and more seconds for each degree of the gaze.
_TURN, _TURN_DEGREE = 0.25, 0.004
#: Mean and largest size of glances, degrees. The sizes are distributed exponentially [Lee 2002].
_GLANCE, _LARGEST_GLANCE = 6.9, 12.0
#: Shortest and longest time that the eyes rest between two glances, seconds.
_FIXATION = (0.4, 3.0)
#: While the eyes look at something, glances are reduced to this share.
_FIXED = 0.1
#: Shortest and longest syllable, seconds. Speech has a rhythm of 2 to 7 Hz [Chandrasekaran 2009].
_SYLLABLE = (0.15, 0.3)
#: Least and most syllables between two pauses, and the same for the seconds of a pause.
_PHRASE, _PAUSE = (4, 13), (0.25, 0.6)
#: Shapes of the mouth for consonants, and for vowels by the names of VRM: weights by action, of both sides.
_CONSONANTS: Sequence[Mapping[str, float]] = read_table("faces")["consonants"]
VOWELS: Mapping[str, Mapping[str, float]] = read_table("faces")["vowels"]


def linear(share: Array) -> Array:
    """Share of a linear change, such as between the frames of recordings."""
    return share


@dataclass(frozen=True, eq=False)
class WeightTrack:
    """Weights of some actions over time.

    Attributes:
        actions: Numbers of A actions.
        times: (K,) seconds, rising. Before the first time and after the last one, the weights do not change.
        weights: (K, A).
        period: Seconds after which the weights repeat.
        ease: Function of the share of the time between two neighbours of ``times``. Returns the share of the
            change.
    """

    actions: tuple[int, ...]
    times: Array
    weights: Array
    period: float = math.inf
    ease: Callable[[Array], Array] = smooth_step

    def at(self, times: Array) -> Array:
        """Weights (N, A) at times (N,)."""
        if self.period < math.inf:
            times = times % self.period
        after = np.clip(np.searchsorted(self.times, times, side="right"), 1, max(len(self.times) - 1, 1))
        after = np.minimum(after, len(self.times) - 1)
        before = np.maximum(after - 1, 0)
        span = np.maximum(self.times[after] - self.times[before], 1e-9)
        share = self.ease(np.clip((times - self.times[before]) / span, 0.0, 1.0))[:, None]
        return np.asarray(self.weights[before] + share * (self.weights[after] - self.weights[before]))

    @classmethod
    def of_points(cls, points: Sequence[tuple[float, Array]], period: float = math.inf) -> WeightTrack:
        """Track through weights (52,) at rising times. ``points``: times with their weights."""
        weights = np.array([weight for _, weight in points])
        actions = np.flatnonzero(weights.any(axis=0))
        times = np.array([time for time, _ in points])
        return cls(tuple(actions.tolist()), times, weights[:, actions], period)


def key_track(keys: Sequence[tuple[float, float, Array]]) -> WeightTrack:
    """Track of keys in the order of time. Each key has a time, the seconds of the change, and weights (52,).
    A key at 0 holds from the start."""
    points: list[tuple[float, Array]] = [(-1.0, np.zeros(len(ACTIONS)))]
    for time, blend, weights in keys:
        if time == 0:
            points = [(-1.0, weights)]
            continue
        track = WeightTrack.of_points(points)
        start = np.zeros(len(ACTIONS))
        start[list(track.actions)] = track.at(np.array([time]))[0]
        points = [point for point in points if point[0] < time]
        points += [(time, start), (time + max(blend, 1e-3), weights)]
    return WeightTrack.of_points(points)


def blinks(uniform: RandomNumbers) -> WeightTrack:
    """Make blinks of both eyes for :data:`LIFE_SECONDS`."""
    closed = face_weights({"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0})
    middle = math.log(60 / _BLINKS) - _SPREAD**2 / 2
    normal = statistics.NormalDist(middle, _SPREAD)
    points: list[tuple[float, Array]] = [(0.0, 0 * closed)]
    time = 0.0
    while True:
        interval = math.exp(normal.inv_cdf(min(max(uniform(), 1e-6), 1 - 1e-6)))
        # rounded, since logarithms may differ between two machines
        time += round(max(interval, _SHORTEST), 3)
        if time + _BLINK[-1][0] > LIFE_SECONDS:
            return WeightTrack.of_points(points, LIFE_SECONDS)
        points += [(time + after, share * closed) for after, share in _BLINK]


def saccade_seconds(degrees: float) -> float:
    """Duration (seconds) of one quick turn of the eyes by an angle."""
    return _SACCADE + _SACCADE_DEGREE * degrees


def turn_seconds(degrees: float) -> float:
    """Duration (seconds) of a turn of the head after the gaze, which turned by an angle at once."""
    return _TURN + _TURN_DEGREE * degrees


def glances(uniform: RandomNumbers) -> WeightTrack:
    """Make small movements of the eyes around the point that they look at, for :data:`LIFE_SECONDS`."""
    points: list[tuple[float, Array]] = [(0.0, np.zeros(len(ACTIONS)))]
    time, before, eyes = 0.0, np.zeros(2), points[0][1]
    while True:
        time += round(_FIXATION[0] + (_FIXATION[1] - _FIXATION[0]) * uniform(), 3)
        size = -_GLANCE * math.log(max(uniform(), 1e-6))
        size, direction = round(min(size, _LARGEST_GLANCE), 2), 2 * math.pi * uniform()
        # the eyes move more to the sides than up and down
        now = np.round([size * math.cos(direction), 0.5 * size * math.sin(direction)], 2)
        if time + 0.2 > LIFE_SECONDS:
            return WeightTrack.of_points([*points, (LIFE_SECONDS, points[0][1])], LIFE_SECONDS)
        points.append((time, eyes))
        eyes = look_weights(np.radians(now))
        points.append((time + round(saccade_seconds(math.dist(now, before)), 3), eyes))
        before = now


def look_weights(angles: Array) -> Array:
    """Weights (52,) that make both eyes look to yaw and pitch (2,), radians."""
    return with_looks(np.zeros((1, len(ACTIONS))), np.broadcast_to(angles, (1, 2, 2)))[0]


def speech(start: float, seconds: float, uniform: RandomNumbers) -> WeightTrack:
    """Make a mouth that speaks for some seconds. Each syllable is a consonant and a vowel. There are
    pauses."""
    silence = np.zeros(len(ACTIONS))
    points, time, left = [(start, silence)], start, 0
    while True:
        if left == 0:
            if len(points) > 1:
                points.append((time, silence))
                time += _between(_PAUSE, uniform)
                points.append((time, silence))
            left = int(_between(_PHRASE, uniform))
        length, strength = _between(_SYLLABLE, uniform), _between((0.7, 1.1), uniform)
        consonant, vowel = (_mouth(each, uniform) for each in (_CONSONANTS, tuple(VOWELS.values())))
        if time + length > start + seconds:
            return WeightTrack.of_points([*points, (max(start + seconds, time + 0.1), silence)])
        points += [(time + 0.3 * length, consonant), (time + 0.7 * length, strength * vowel)]
        time, left = time + length, left - 1


def _between(limits: tuple[float, float], uniform: RandomNumbers) -> float:
    return limits[0] + (limits[1] - limits[0]) * uniform()


def _mouth(mouths: Sequence[Mapping[str, float]], uniform: RandomNumbers) -> Array:
    """Choose one of some shapes of the mouth. Returns its weights (52,)."""
    chosen = mouths[min(int(len(mouths) * uniform()), len(mouths) - 1)]
    return face_weights(both_sides(chosen))


def seen(human: Actor, target: GazeTarget, times: Array, turned: bool) -> Array:
    """Points (N, 3) of a target that a human looks at.

    Args:
        human: Who looks.
        target: The target.
        times: Scene times (N,).
        turned: If the target is a human, take it with its head turned.
    """
    if not isinstance(target, str):
        return np.broadcast_to(np.array(target), (len(times), 3))
    others: World = human.asking()
    if others.is_human(target):
        return others.eyes(target, times, turned)
    return others.camera_position(target, times)


@dataclass(frozen=True)
class Gaze:
    """A change of the gaze: at a time, the eyes and the head turn to a target.

    If the target is a human, the eyes look into the eyes of the target. The head turns to the place where the
    eyes of the target are before the head of the target turns. So two heads can turn to each other.

    Attributes:
        time: Seconds of the scene.
        target: What the eyes look at. If None, they look ahead.
    """

    time: float
    target: GazeTarget | None


@dataclass(frozen=True, eq=False)
class Face:
    """The face of a human over scene time.

    Attributes:
        tracks: Weights of actions. The weights of all tracks are added, and the sum is limited to 1.
        takes: The same, but over the time of a file that also moves the body.
        body_file: Path of that file.
        glances: Movements of the eyes while they have no target. None if there are none.
        gazes: Changes of the gaze, in the order of time.
        head: Share by which the head turns with the gaze. 0 is not at all, 1 is as much as people turn it.
    """

    tracks: tuple[WeightTrack, ...] = ()
    takes: tuple[WeightTrack, ...] = ()
    body_file: str = ""
    glances: WeightTrack | None = None
    gazes: tuple[Gaze, ...] = ()
    head: float = 0.0

    @cached_property
    def _actions(self) -> tuple[int, ...]:
        """Numbers of the actions that move at any time, in order."""
        glances = () if self.glances is None else (self.glances,)
        tracks = (*self.tracks, *self.takes, *glances)
        return tuple(sorted({action for track in tracks for action in track.actions}))

    @cached_property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints that carry the face."""
        attended = (GAZE_JOINT, HEAD_JOINT) if self.turns_head else (GAZE_JOINT,) if self.gazes else ()
        return (*(FACE_JOINT + ACTIONS[action] for action in self._actions), *attended)

    @property
    def turns_head(self) -> bool:
        """Whether the head turns with the gaze at any time."""
        return bool(self.gazes) and self.head > 0

    def add(self, poses: JointPoses, seconds: float, human: Actor) -> JointPoses:
        """Add the joints that carry the face to poses (N = 1) of the motion of a human at a scene time."""
        if not self.joints:
            return poses
        times = seconds + AROUND
        attended = [self._gaze(times, human)]
        weights = self._weights(times, attended[0][0], human)[:, list(self._actions)]
        if self.turns_head:
            attended.append(self._head(times, human))
        count, step = len(self.joints), 2 * VELOCITY_STEP
        angles = np.column_stack([weights, *(shares for shares, _ in attended)])[:, :count]
        rotations, angular = np.zeros((count, 4)), np.zeros((count, 3))
        rotations[:, 0], rotations[:, 3] = np.sin(angles[1] / 2), np.cos(angles[1] / 2)
        angular[:, 0] = (angles[2] - angles[0]) / step
        positions, linear = poses.at_first_joint(count)
        if self.gazes:
            for number, (_, points) in enumerate(attended, count - len(attended)):
                positions[number], linear[number] = points[1], (points[2] - points[0]) / step
        return poses.with_joints(self.joints, rotations, angular, positions, linear)

    def _weights(self, times: Array, shares: Array, human: Actor) -> Array:
        """Weights (N, 52) at times (N,), where the gaze has the shares (N,)."""
        weights = np.zeros((len(times), len(ACTIONS)))
        for track in self.tracks:
            weights[:, track.actions] += track.at(times)
        if self.takes and human.plays(self.body_file):
            played = human.played(times)
            if (np.diff(played) < 0).any():  # a new cycle began between the times
                played[:] = played[len(played) // 2]
            for take in self.takes:
                weights[:, take.actions] += take.at(played)
        if self.gazes:
            weights[:, LOOKS] *= 1 - shares[:, None, None, None]
        if self.glances is not None:
            left = 1 - (1 - _FIXED) * shares
            weights[:, self.glances.actions] += left[:, None] * self.glances.at(times)
        return np.clip(weights, 0.0, 1.0)

    def head_at(self, times: Array, human: Actor) -> tuple[Array, Array]:
        """Shares (N,) of the turn of the head, and points (N, 3) that it turns to, at times (N,)."""
        shares, points = np.zeros(len(times)), np.zeros((len(times), 3))
        begun = np.searchsorted([gaze.time for gaze in self.gazes], times, side="right")
        for number in np.unique(begun):
            now = begun == number
            shares[now], points[now] = self._head(times[now], human)
        return shares, points

    def _head(self, times: Array, human: Actor) -> tuple[Array, Array]:
        """Do the same as :meth:`_gaze` for the head."""
        shares, points = self._attended(partial(seen, human, turned=False), turn_seconds, times, human)
        return self.head * shares, points

    def _gaze(self, times: Array, human: Actor) -> tuple[Array, Array]:
        """Shares (N,) of the gaze, and its points (N, 3), at times (N,) around a frame."""
        return self._attended(partial(seen, human, turned=True), saccade_seconds, times, human)

    def _attended(
        self,
        seen_at: Callable[[GazeTarget, Array], Array],
        seconds: Callable[[float], float],
        times: Array,
        human: Actor,
    ) -> tuple[Array, Array]:
        """Shares (N,) and points (N, 3) of a gaze at times (N,) around a frame.

        Args:
            seen_at: Returns the points of a target.
            seconds: Function that returns the duration of a change by an angle in degrees.
            times: Times. All are between the same two gazes.
            human: The human who has the gaze.
        """
        number = sum(gaze.time <= times[len(times) // 2] for gaze in self.gazes) - 1
        shares, points = np.zeros(len(times)), np.zeros((len(times), 3))
        if number < 0:
            return shares, points
        time, after = self.gazes[number].time, self.gazes[number].target
        before = self.gazes[number - 1].target if number else None
        done = np.ones(len(times))
        # a gaze that begins with the scene does not need time to turn
        if time > 0 and times.min() < time + seconds(180):
            lasts = seconds(_change(np.array([time]), before, after, seen_at, human))
            done = smooth_step((times - time) / lasts)
        if after is None or before is None:
            target = before if after is None else after
            if target is not None:
                shares, points = done if after is not None else 1 - done, seen_at(target, times)
            return shares, points
        if done.min() == 1:
            return np.ones(len(times)), seen_at(after, times)
        eyes = human.eye_rays(times)[0]
        start, end = seen_at(before, times) - eyes, seen_at(after, times) - eyes
        near, far = (np.linalg.norm(line, axis=-1) for line in (start, end))
        return np.ones(len(times)), eyes + (near + done * (far - near))[:, None] * _turned(start, end, done)


def _change(
    times: Array,
    before: GazeTarget | None,
    after: GazeTarget | None,
    seen_at: Callable[[GazeTarget, Array], Array],
    human: Actor,
) -> float:
    """Degrees by which a gaze changes at a time (1,)."""
    eyes, ahead = human.eye_rays(times)
    start, end = (
        ahead if target is None else unit_vectors(seen_at(target, times) - eyes) for target in (before, after)
    )
    return float(np.degrees(angle_between(start, end))[0])


def _turned(start: Array, end: Array, share: Array) -> Array:
    """Unit vectors (N, 3) on the way from start directions to end directions, at a share (N,) of the way."""
    angle = angle_between(unit_vectors(start), unit_vectors(end))
    sine = np.sin(angle)
    weights = np.where(
        sine > 1e-6,
        np.stack([np.sin((1 - share) * angle), np.sin(share * angle)]) / np.maximum(sine, 1e-6),
        np.stack([1 - share, share]),
    )
    return unit_vectors(weights[0][:, None] * unit_vectors(start) + weights[1][:, None] * unit_vectors(end))


def key_tracks(
    keys: Sequence[FaceKeyConfig], numbers: Callable[[str], RandomNumbers]
) -> tuple[WeightTrack, ...]:
    """Make tracks of the expressions, actions and speech of keys. ``numbers``: gives random numbers for a
    purpose."""
    keys = sorted(keys, key=lambda key: key.time)
    expressions = [
        (key.time, key.blend, key.strength * face_weights(expression(key.expression)))
        for key in keys
        if key.expression is not None
    ]
    actions = [(key.time, key.blend, face_weights(key.actions)) for key in keys if key.actions is not None]
    spoken = [(key.time, key.speak) for key in keys if key.speak is not None]
    mouths = [speech(time, seconds, numbers(f"speech {time:g}")) for time, seconds in spoken]
    return (*(key_track(each) for each in (expressions, actions) if each), *mouths)


@dataclass(frozen=True, eq=False)
class FacePoses:
    """A face at N times: weights (N, 52), and the points (N, 3) of gaze and head with their shares (N,)."""

    weights: Array
    points: Array
    shares: Array
    head_points: Array
    head_shares: Array


def carried_face(carried: JointPoses) -> FacePoses:
    """Read the face from the joints that :meth:`Face.add` appends."""
    # q and -q are the same rotation
    angles = 2 * np.arctan(carried.rotations[..., 0] / carried.rotations[..., 3])
    weights = np.zeros((len(angles), len(ACTIONS)))
    nowhere = np.zeros((len(angles), 3)), np.zeros(len(angles))
    attended = {GAZE_JOINT: nowhere, HEAD_JOINT: nowhere}
    for number, name in enumerate(carried.names):
        if name in attended:
            attended[name] = carried.positions[:, number], np.clip(angles[:, number], 0.0, 1.0)
        else:
            weights[:, ACTIONS.index(name.removeprefix(FACE_JOINT))] = angles[:, number]
    return FacePoses(np.clip(weights, 0.0, 1.0), *attended[GAZE_JOINT], *attended[HEAD_JOINT])


def check_face(poses: JointPoses) -> None:
    """Raise MotionError if joints cannot carry a face: an action is unknown, or a weight is out of range."""
    for number, name in enumerate(poses.names):
        if not name.startswith(FACE_JOINT):
            continue
        action = name.removeprefix(FACE_JOINT)
        if name not in FACE_JOINTS:
            raise MotionError(unknown("action of the face", action, ACTIONS, most=5))
        x, y, z, w = poses.rotations[0, number].tolist()
        weight = 2 * math.atan2(math.copysign(x, x * w), abs(w))
        if math.hypot(y, z) > 1e-6 or not -1e-6 <= weight <= 1 + 1e-6:
            raise MotionError(
                f"the angle of {FACE_JOINT}{action[:40]} about x is its weight: from 0 to 1, not {weight:.4g}"
            )


@dataclass(frozen=True, eq=False)
class FaceLayer(PoseLayer):
    """Turns head and eyes to what they look at, opens the jaw, and moves the skin of the face.

    Attributes:
        eyes: The eyes; None for a body without eyes.
        jaw: The jaw, which moves with the face; None for one that does not.
    """

    name: ClassVar[str] = "face"
    stage: ClassVar[PoseStage] = PoseStage.HEAD  # to FACE
    topic: ClassVar[str] = "face"
    settings: Face | None = None
    eyes: Eyes | None = None
    jaw: Jaw | None = None

    @classmethod
    def of(cls, human: Human) -> FaceLayer:
        return cls(eyes=Eyes.of(human.skeleton))

    @property
    def rest(self) -> Rated | None:
        return None if self.settings is None else FACE_AT_REST

    def encode(self, poses: JointPoses, seconds: float, human: Actor) -> JointPoses:
        return poses if self.settings is None else self.settings.add(poses, seconds, human)

    def place(self, joints: Array, times: Array, human: Actor) -> Array:
        if self.settings is not None and self.settings.turns_head and self.eyes is not None:
            shares, points = self.settings.head_at(times, human)
            self.eyes.turn_head(joints, points, shares)
        return joints

    def carries(self, joint: str) -> bool:
        return joint.startswith(FACE_JOINT)

    def sent(self, poses: JointPoses, human: Actor) -> tuple[str, ...]:
        names = super().sent(poses, human)
        if names:
            if self.settings is None:
                raise MotionError(f"the scene gives {human.name} no face: add the key face: {{}}")
            check_face(poses)
        return names

    def before_fit(self, body: BodyPoses, own: JointPoses) -> FacePoses:
        return carried_face(own)

    def after_fit(self, body: BodyPoses, data: FacePoses) -> None:
        eyes, weights = self.eyes, data.weights
        if eyes is not None:
            if data.head_shares.any():
                eyes.turn_head(body.bones, data.head_points, data.head_shares)
            angles = looked_angles(weights)
            if data.shares.any():
                angles += data.shares[:, None, None] * eyes.angles_to(body.bones, data.points)
            angles = within_limits(angles)
            eyes.turn(body.bones, angles)
            weights = with_looks(weights, angles)
        body.joints = body.bones if self.jaw is None else self.jaw.open(body.bones, weights, body.sizes)
        body.values[self.topic] = FACE_AT_REST, weights

    def skinned(self, human: Human, values: Array) -> Array:
        return human.of_actions(values)

    def moved_bone(self, rated: Rated) -> int:
        if self.jaw is None or not self.jaw.moves(np.stack([rated.values, rated.rates])):
            return -1
        return self.jaw.bone

    def undone(self, bone: Array, values: Array, size: float) -> Array:
        assert self.jaw is not None
        return self.jaw.closed(bone, values, size)


LAYER = FaceLayer
