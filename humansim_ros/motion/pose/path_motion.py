"""Walks along a planned path. The phase of the gait follows the distance, so that feet do not slide."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import scipy
import scipy.ndimage
import scipy.spatial
from numpy.typing import ArrayLike

from humansim_ros.errors import MotionError
from humansim_ros.geometry import (
    VELOCITY_STEP,
    matrix_to_quaternion,
    multiply_quaternions,
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
    slerp,
    smooth_step,
)
from humansim_ros.motion.body.kinematics import JointPoses
from humansim_ros.motion.pose.contacts import Leg, true_runs, two_bone
from humansim_ros.motion.pose.world_motion import Placement, WorldMotion, yaw_matrices
from humansim_ros.types import Array, Indices

#: Number of poses of a gait in one cycle.
_PHASES = 120
#: Shortest stride of a walk, metres, and largest turn within a cycle, radians.
_LEAST_STRIDE, _MOST_TURN = 0.3, 0.1
#: Heading, phase and stride are computed at this number of times for each point of a path.
_FINE = 4
#: Speed and direction are smoothed over these times (standard deviation, seconds).
_SMOOTH_SPEED, _SMOOTH_DIRECTION = 0.25, 0.3
#: A person who is faster than the first value (m/s) faces the direction of the walk. The second value is the
#: angular speed of a turn on the spot, radians per second.
_FACING, _TURN = 0.15, 1.6
#: Metres per radian of a turn. A turn on the spot needs as many steps as a straight walk of this length.
_TURN_ARM = 0.35
#: A foot stands if its speed relative to the walk is below the first value. It is kept in place if the share
#: of the stride is at least the second value. The others are the largest corrections, metres and radians.
_SLOW, _PINNED, _MAX_SHIFT, _MAX_FOOT_TURN = 1.0, 0.15, 0.25, 0.7
#: Shortest time of a foot on the floor, as a share of the cycle.
_SHORTEST_STANCE = 0.08
#: Smallest length of steps, as a share of the stride. People who are slower take fewer steps instead.
_LEAST_SHARE = 0.15


@dataclass(frozen=True)
class Gait:
    """Poses of a walk on the spot, and the pose of somebody who stands. Joint positions are relative to a
    point on the floor. The person faces +x.

    Attributes:
        stride, seconds: Length (metres) and duration (seconds) of a cycle of two steps.
        positions, rotations: Poses of a cycle from phase 0 to 1: (P + 1, J, 3) metres, (P + 1, J, 4) xyzw.
        standing: Positions (J, 3) and rotations (J, 4) of somebody who stands.
        legs: Left leg and right leg.
        leg_lengths: Lengths of thigh and shin of both legs, (2, 2) metres.
        stances: For each foot, (S, 2) phases at which the foot comes to the floor and leaves the floor. The
            second phase may be above 1.
    """

    stride: float
    seconds: float
    positions: Array
    rotations: Array
    standing: tuple[Array, Array]
    legs: tuple[Leg, Leg]
    leg_lengths: Array
    stances: tuple[Array, Array]

    @classmethod
    def of(cls, walk: WorldMotion, standing: WorldMotion | None = None) -> Gait:
        """Make a gait from a cycle of a walk. Raises MotionError if the walk does not go straight ahead.

        ``standing``: a motion with the same joints; the person stands in its first frame. If None, the middle
        of the gait is used.
        """
        cycle = replace(walk, placement=Placement(), loop="continue", speed=1.0, correction=None)
        hips = walk.match.roles["Hips"]
        phases = np.linspace(0.0, 1.0, _PHASES + 1)
        # in the second cycle, the end of the first cycle has faded into the start
        poses = cycle.sample((1 + phases * (1 - 1e-9)) * cycle.cycle_length)
        way = poses.positions[-1, hips, :2] - poses.positions[0, hips, :2]
        stride, turn = float(np.linalg.norm(way)), cycle.cycle_rotations(np.ones(1))[0]
        if stride < _LEAST_STRIDE or abs(turn[1, 0]) > _MOST_TURN:
            raise MotionError(
                "people of a crowd need a motion that walks straight ahead, such as walk_straight: this one "
                + ("stays in place" if stride < _LEAST_STRIDE else "turns"),
                path=walk.motion.path,
            )
        ahead = poses.positions.copy()
        ahead[..., :2] -= poses.positions[0, hips, :2] + phases[:, None, None] * way
        ahead[..., :2] -= ahead[:-1, hips, :2].mean(axis=0)
        positions, rotations = turned(
            ahead, poses.rotations, np.full(len(ahead), -np.arctan2(way[1], way[0]))
        )
        if standing is None or standing.names != walk.names:
            each = rotations[:-1].swapaxes(0, 1)
            mean = [scipy.spatial.transform.Rotation.from_quat(one).mean().as_quat() for one in each]
            still = positions[:-1].mean(axis=0), np.array(mean)
        else:
            pose = replace(standing, placement=Placement(), loop="none", speed=1.0).sample(0.0)
            still = pose.positions[0], pose.rotations[0]
        left, right = (Leg.of(side, walk.motion, walk.match.roles) for side in ("Left", "Right"))
        stances = tuple(_stances(positions[:, leg.ankle, 0] / stride) for leg in (left, right))
        joints = np.array([(leg.hip, leg.knee, leg.ankle) for leg in (left, right)])
        lengths = np.linalg.norm(np.diff(positions[0, joints], axis=1), axis=-1)
        gait = stride, cycle.duration, positions, rotations, still
        return cls(*gait, (left, right), lengths, (stances[0], stances[1]))

    def at(self, phases: Array, shares: Array) -> tuple[Array, Array]:
        """Positions (N, J, 3) and rotations (N, J, 4) at phases (N,), with steps of shares (N,) of the
        stride."""
        before, part = self._between(phases)
        positions = self.positions[before] + part[..., None] * (
            self.positions[before + 1] - self.positions[before]
        )
        rotations = slerp(self.rotations[before], self.rotations[before + 1], part)
        still, upright = self.standing
        share = shares[:, None]
        positions = still + share[..., None] * (positions - still)
        return positions, slerp(np.broadcast_to(upright, rotations.shape), rotations, share)

    def ankles(self, feet: Indices, phases: Array, shares: Array) -> Array:
        """Positions (N, 3) of the ankles of ``feet`` (N,): 0 left, 1 right. See :meth:`at`."""
        joints = np.array([leg.ankle for leg in self.legs])[feet]
        before, part = self._between(phases)
        path, still = self.positions[before, joints], self.standing[0][joints]
        path = path + part * (self.positions[before + 1, joints] - path)
        return np.asarray(still + shares[:, None] * (path - still))

    @staticmethod
    def _between(phases: Array) -> tuple[Indices, Array]:
        """For phases (N,): number (N,) of the pose before each, and share (N, 1) of the way to the next."""
        place = (phases % 1.0) * _PHASES
        before = np.minimum(place.astype(int), _PHASES - 1)
        return before, (place - before)[:, None]


def _stances(path: Array) -> Array:
    """Phases (S, 2) at which a foot lands and leaves the floor. ``path``: (P + 1,) its way in strides."""
    slow = 1 + np.gradient(path, 1 / _PHASES)[:-1] < _SLOW
    if slow.all() or not slow.any():
        return np.array([[0.0, 0.5]])
    start = int(np.flatnonzero(~slow)[0])
    runs = start + np.array(true_runs(np.roll(slow, -start)))
    runs = runs[np.ptp(runs, axis=1) > _SHORTEST_STANCE * _PHASES]
    runs -= runs[:, :1] // _PHASES * _PHASES
    return np.asarray(runs[np.argsort(runs[:, 0])] / _PHASES)


def turned(positions: Array, rotations: Array, yaws: Array) -> tuple[Array, Array]:
    """Turn poses (N, J, 3) and (N, J, 4) by ``yaws`` (N,) radians about the vertical axis at the origin."""
    c, s, zero = np.cos(yaws)[:, None], np.sin(yaws)[:, None], np.zeros(len(yaws))
    x, y, z = np.moveaxis(positions, -1, 0)
    turn = rotation_vector_to_quaternion(np.stack([zero, zero, yaws], axis=-1))[:, None]
    return np.stack([c * x - s * y, s * x + c * y, z], axis=-1), multiply_quaternions(turn, rotations)


@dataclass(frozen=True)
class WalkPath:
    """A closed path of a person on the floor over time. It is a cubic B-spline, so its velocity has no jumps.

    Attributes:
        points: (K, 2) control points, metres in ``map``, at equal intervals of time. After the last point,
            the first one comes again.
        step: Seconds between two control points.
        facing: Heading of a person who never walks, radians.
    """

    points: Array
    step: float
    facing: float = 0.0

    @property
    def duration(self) -> float:
        """Seconds that a round takes."""
        return len(self.points) * self.step

    @cached_property
    def _spline(self) -> scipy.interpolate.BSpline:
        count = len(self.points)
        around = self.points[np.arange(-1, count + 2) % count]
        return scipy.interpolate.BSpline(self.step * (np.arange(count + 7) - 3.0), around, 3)

    def positions(self, times: Array) -> Array:
        """Positions (N, 2) at times (N,) in seconds."""
        return np.asarray(self._spline(times % self.duration))

    def stepping(self, gait: Gait, size: float) -> scipy.interpolate.PchipInterpolator:
        """Make a function of the time in a round that returns heading in radians, phase, and share of the
        stride. ``size``: size of the person relative to the motion."""
        step = self.step / _FINE
        times = step * np.arange(_FINE * len(self.points) + 1)
        velocity = np.asarray(self._spline(np.minimum(times, times[-1] * (1 - 1e-12)), 1))
        heading = _headings(_smooth(velocity, _SMOOTH_DIRECTION / step), step, self.facing)
        turn = np.gradient(heading, step)
        # somebody who turns on the spot steps, too
        speed = np.hypot(np.linalg.norm(velocity, axis=-1), _TURN_ARM * turn)
        natural = size * gait.stride / gait.seconds
        # the length and the rate of steps grow equally with the speed
        share = np.minimum(1.0, np.sqrt(_smooth(speed, _SMOOTH_SPEED / step) / natural))
        cycles = speed / (size * gait.stride * np.maximum(share, _LEAST_SHARE))
        phase = np.concatenate([[0.0], np.cumsum((cycles[1:] + cycles[:-1]) * (step / 2))])
        return scipy.interpolate.PchipInterpolator(times, np.stack([heading, phase, share], axis=-1))


def _smooth(values: Array, deviation: float) -> Array:
    """Smooth values (K + 1, ...) of a closed path over time. The last value is the same as the first."""
    inner = scipy.ndimage.gaussian_filter1d(values[:-1], deviation, axis=0, mode="wrap")
    return np.concatenate([inner, inner[:1]])


def _headings(velocity: Array, step: float, facing: float) -> Array:
    """Headings (K + 1,) along velocities (K + 1, 2). A person who stands turns just before walking on."""
    count = len(velocity) - 1
    moving = np.flatnonzero(np.linalg.norm(velocity[:count], axis=-1) > _FACING)
    if not len(moving):
        return np.full(count + 1, facing)
    known = np.append(moving, moving[0] + count)
    angles = np.unwrap(np.arctan2(velocity[known % count, 1], velocity[known % count, 0]))
    places, headings = [float(known[0])], [angles[0]]
    for before, after, old, new in zip(known[:-1], known[1:], angles[:-1], angles[1:], strict=True):
        turning = max(1.0, abs(new - old) / _TURN / step)
        if after - before > turning + 1:
            places.append(after - turning)
            headings.append(old)
        places.append(float(after))
        headings.append(new)
    at = np.arange(count + 1)
    # the path is closed, so headings from the end of the round come before the first known heading
    whole = angles[-1] - angles[0]
    places = [*(place - count for place in places[:-1]), *places]
    headings = [*(heading - whole for heading in headings[:-1]), *headings]
    return np.interp(at, places, headings)


@dataclass(frozen=True)
class PathMotion(WorldMotion):
    """A walk along a path on the floor. Times are those of the path; sizes are those of the person.

    Attributes:
        gait: Walk on the spot.
        path: Path of the person.
        size: Size of the person relative to the motion.
    """

    gait: Gait = field(kw_only=True)
    path: WalkPath = field(kw_only=True)
    size: float = field(default=1.0, kw_only=True)

    @property
    def cycle_length(self) -> float:
        """Length of a round, seconds of the path."""
        return self.path.duration

    @cached_property
    def _phases(self) -> Array:
        """Phase of the gait at each time in ``_stepping.x``."""
        return np.asarray(self._stepping(self._stepping.x)[:, 1])

    @cached_property
    def _stepping(self) -> scipy.interpolate.PchipInterpolator:
        return self.path.stepping(self.gait, self.size)

    def sample(self, times: ArrayLike, file_offset: float = 0.0) -> JointPoses:
        times = self.file_times(times, file_offset)
        return JointPoses(self.names, *_Walks((self,), len(times)).poses(times))

    def sample_with_velocities(self, times: ArrayLike, file_offset: float = 0.0) -> JointPoses:
        (poses,) = sample_together([self], [self.file_times(times, file_offset)])
        return poses


def sample_together(motions: Sequence[PathMotion], times: Sequence[Array]) -> list[JointPoses]:
    """Sample several walks with the same gait at once, with velocities: takes little longer than for one
    walk. ``times``: file times of each walk, (N,) seconds. N must be the same for all walks."""
    count = len(times[0])
    around = np.concatenate([[t - VELOCITY_STEP, t, t + VELOCITY_STEP] for t in times])
    positions, rotations = (
        each.reshape(len(motions), 3, count, *each.shape[1:])
        for each in _Walks(motions, 3 * count).poses(around.ravel())
    )
    return [
        JointPoses.with_velocities(motion.names, places, turns, speed=motion.speed)
        for motion, places, turns in zip(motions, positions, rotations, strict=True)
    ]


@dataclass(frozen=True)
class _Walks:
    """Walks of M people with one gait. Arrays of N samples have ``count`` samples of the first person, then
    of the next, and so on. (K N,) stands for K such arrays, one after the other.

    Attributes:
        motions: The walks.
        count: Number of samples of each person.
    """

    motions: Sequence[PathMotion]
    count: int

    def _of_each(self, evaluate: Callable[[PathMotion, Array], Array], values: Array) -> Array:
        """Call a function for each person with the person's rows of ``values`` (K N,). Returns (K N, ...)."""
        parts = values.reshape(-1, len(self.motions), self.count)
        found = [evaluate(motion, parts[:, i].ravel()) for i, motion in enumerate(self.motions)]
        shape = found[0].shape[1:]
        each = np.stack([one.reshape(len(parts), self.count, *shape) for one in found], axis=1)
        return each.reshape(len(values), *shape)

    def _stepping(self, times: Array) -> Array:
        """Heading, phase and share of the stride (3, K N) at the times."""
        return self._of_each(lambda motion, at: np.asarray(motion._stepping(at)), times).T

    def _times_of(self, phases: Array) -> Array:
        """Seconds of the paths (K N,) at which the paths reach the phases."""
        return self._of_each(lambda motion, at: np.interp(at, motion._phases, motion._stepping.x), phases)

    def _ground(self, times: Array) -> Array:
        """Places (K N, 2) of the paths at times."""
        return self._of_each(lambda motion, at: motion.path.positions(at), times)

    @property
    def _sizes(self) -> Array:
        """Size (N,) of the person of each sample, relative to the motion."""
        return np.repeat([motion.size for motion in self.motions], self.count)

    def poses(self, times: Array) -> tuple[Array, Array]:
        """Positions (N, J, 3) and rotations (N, J, 4) of the joints at times (N,), seconds of the paths."""
        gait, sizes = self.motions[0].gait, self._sizes
        times = times % np.repeat([motion.cycle_length for motion in self.motions], self.count)
        heading, phase, share = self._stepping(times)
        positions, rotations = turned(*gait.at(phase, share), heading)
        positions *= sizes[:, None, None]
        positions[..., :2] += self._ground(times)[:, None]
        matrices = quaternion_to_matrix(rotations)
        moves = self._shifts(times, phase)
        moves *= smooth_step(share / _PINNED)[:, None]
        shifts, turns = moves[..., :3], moves[..., 3]
        shifts *= np.minimum(1.0, _MAX_SHIFT / np.maximum(np.linalg.norm(shifts, axis=-1), 1e-9))[..., None]
        legs = gait.legs
        goals = positions[:, [leg.ankle for leg in legs]].swapaxes(0, 1) + shifts
        for leg, (thigh, shin) in zip(legs, gait.leg_lengths, strict=True):
            # a pose between two others has legs that are too short
            leg.stretch(positions, sizes * thigh, sizes * shin)
        joints = positions[:, [(leg.hip, leg.knee, leg.ankle) for leg in legs]]
        hips, knees, ankles = joints.transpose(2, 1, 0, 3).reshape(3, -1, 3)
        thighs, shins = two_bone(hips, knees, ankles, goals.reshape(-1, 3))
        feet = yaw_matrices(turns.ravel())
        for leg, *parts in zip(
            legs, *(part.reshape(2, -1, 3, 3) for part in (thighs, shins, feet)), strict=True
        ):
            leg.turn(positions, matrices, *parts)
        return positions, matrix_to_quaternion(matrices)

    def _shifts(self, times: Array, phases: Array) -> Array:
        """Corrections (2, N, 4) that keep both feet in place: a shift, metres, and a turn, radians.
        ``times``: (N,) seconds of the paths. ``phases``: (N,) phases at these times."""
        feet, middles, at, weights = [], [], [], []
        for foot, stances in enumerate(self.motions[0].gait.stances):
            number = np.floor(phases).astype(int) * len(stances) - 1
            number += np.searchsorted(stances[:, 0], phases % 1.0, side="right")
            (cycle, which), (next_cycle, following) = (
                np.divmod(each, len(stances)) for each in (number, number + 1)
            )
            (first, last), (start, end) = (cycle + stances[which].T, next_cycle + stances[following].T)
            in_air = np.clip((phases - last) / np.maximum(start - last, 1e-9), 0.0, 1.0)
            left, back = np.split(self._times_of(np.concatenate([last, start])), 2)
            feet.append(np.full(2 * len(times), foot))
            middles.append(np.concatenate([first + last, start + end]) / 2)
            at.append(np.concatenate([np.where(in_air > 0, left, times), back]))
            weights.append(smooth_step(in_air))
        moves = self._to_plant(*(np.concatenate(each) for each in (feet, middles, at)))
        now, after = moves.reshape(2, 2, len(times), 4).swapaxes(0, 1)
        return np.asarray(now + np.array(weights)[..., None] * (after - now))

    def _to_plant(self, feet: Indices, middles: Array, times: Array) -> Array:
        """Vectors (K N, 4) from feet to the places where they will stand, metres, and the angles of their
        turns, radians. Each argument has one value for each row (K N,).

        Args:
            feet: 0 left, 1 right.
            middles: Phases in the middle of the stances.
            times: Seconds at which the feet are still on the way.
        """
        gait, count = self.motions[0].gait, len(times)
        sizes = np.resize(self._sizes, count)
        both = np.concatenate([self._times_of(middles), times])
        heading, phase, share = self._stepping(both)
        c, s = np.cos(heading), np.sin(heading)
        # where the foot will stand, where it is now, and how it would roll from heel to toe on a straight
        # walk
        phases = np.concatenate([phase, phase[count:], middles])
        shares = np.concatenate([share, np.ones(2 * count)])
        ankles = gait.ankles(np.tile(feet, 4), phases, shares)
        planted, now, rolled, flat = sizes[:, None] * ankles.reshape(4, count, 3)
        roll = (rolled - flat) * share[:count, None]
        roll[:, 0] += sizes * gait.stride * share[:count] * (phase[count:] - middles)
        (x, y), (u, v) = (planted + roll)[:, :2].T, now[:, :2].T
        ground = self._ground(both)
        moves = np.zeros((count, 4))
        moves[:, 0] = c[:count] * x - s[:count] * y - (c[count:] * u - s[count:] * v)
        moves[:, 1] = s[:count] * x + c[:count] * y - (s[count:] * u + c[count:] * v)
        moves[:, :2] += ground[:count] - ground[count:]
        moves[:, 3] = np.clip(heading[:count] - heading[count:], -_MAX_FOOT_TURN, _MAX_FOOT_TURN)
        return moves
