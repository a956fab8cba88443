"""Sequences of 3D poses of people (truth or estimate), and the times at which their messages arrived."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MAX_COORDINATE, EvaluationError
from humansim_ros.types import Array

#: People of one frame: joints (K, 3) by the name of the person.
People = Mapping[str, Array]


@dataclass(frozen=True)
class Arrivals:
    """Times and counts of the messages of a sequence.

    Attributes:
        times: (F,) int64 arrival time of the last message of each frame, nanoseconds of any clock.
        latencies: (L,) seconds from the stamp of a frame to its last message, for frames where this is known.
        messages: Number of messages with a stamp, including repeated ones.
        duplicates: Number of messages that add no person to their frame.
        out_of_order: Number of messages that are older than the previous message of their topic.
    """

    times: NDArray[np.int64]
    latencies: Array
    messages: int
    duplicates: int
    out_of_order: int


@dataclass(frozen=True, repr=False)
class PoseSequence:
    """Poses of people over time, of a truth or an estimate.

    Attributes:
        names: Names of the K joints.
        times: (F,) int64 nanoseconds, increasing.
        people: For each frame: joints (K, 3) by person, metres in ``map``; NaN where a joint is absent.
        scores: For each frame: confidence by person. None if the source has no confidence.
        source: Where the poses come from, for messages.
        has_identities: Whether a name means the same person in all frames.
        arrivals: Times and counts of the messages. None for files.
    """

    names: tuple[str, ...]
    times: NDArray[np.int64]
    people: Sequence[People]
    scores: Sequence[Mapping[str, float]] | None = None
    source: str = ""
    has_identities: bool = True
    arrivals: Arrivals | None = None

    def __repr__(self) -> str:
        return f"PoseSequence({len(self.names)} joints, {len(self.times)} frames, {self.source})"

    @property
    def period(self) -> int:
        """Median time between frames in nanoseconds; 0 for a single frame."""
        return int(np.median(np.diff(self.times))) if len(self.times) > 1 else 0

    @cached_property
    def count(self) -> int:
        """Number of poses in all frames."""
        return sum(map(len, self.people))

    def checked(self) -> PoseSequence:
        """Return the sequence itself, if it can be a truth. Raises EvaluationError if the sequence has no
        people."""
        if not any(self.people):
            raise EvaluationError("there are no poses in it", path=self.source)
        return self

    def with_joints(self, joints: Sequence[int], names: Sequence[str]) -> PoseSequence:
        """Copy of the sequence with only the joints of these indices, under new names. People without any of
        these joints are left out."""
        index = list(joints)
        people = [{name: pose[index] for name, pose in frame.items()} for frame in self.people]
        people = [{name: pose for name, pose in frame.items() if _present(pose)} for frame in people]
        return replace(self, names=tuple(names), people=people)

    def mapped(self, matrix: Array) -> PoseSequence:
        """Copy of the sequence with all positions multiplied by a matrix (3, 3)."""
        people = [{name: pose @ matrix.T for name, pose in frame.items()} for frame in self.people]
        return replace(self, people=people)

    def since(self, time: int) -> PoseSequence:
        """Copy of the sequence with only the frames from ``time`` (nanoseconds) on."""
        first = int(np.searchsorted(self.times, time))
        scores = None if self.scores is None else self.scores[first:]
        return replace(self, times=self.times[first:], people=self.people[first:], scores=scores)

    def delayed(self, nanoseconds: int) -> PoseSequence:
        """Copy of the sequence with ``nanoseconds`` added to all times."""
        return replace(self, times=self.times + nanoseconds)


def _present(pose: Array) -> bool:
    return bool(np.isfinite(pose).all(axis=1).any())


@dataclass
class SequenceBuilder:
    """Builds a sequence from poses that come in any order of time and joints. All readers of files use it.

    Attributes:
        source: Where the poses come from, for messages.
        has_identities: Whether a name means the same person in all frames.
    """

    source: str
    has_identities: bool = True
    _joints: dict[str, int] = field(default_factory=dict)
    _frames: dict[int, dict[str, tuple[tuple[str, ...], Array]]] = field(default_factory=dict)
    _scores: dict[int, dict[str, float]] = field(default_factory=dict)

    def add_frame(self, time: int) -> None:
        """Add a time. It counts as a frame even if no person is added."""
        self._frames.setdefault(time, {})

    def add(
        self,
        time: int,
        person: str | None,
        names: tuple[str, ...],
        positions: Array,
        score: float | None = None,
    ) -> None:
        """Add the pose of a person at a time.

        Args:
            time: Nanoseconds.
            person: Name of the person. None for a person without a name.
            names: Names of the joints.
            positions: (len(names), 3) metres. Not finite where a joint is absent.
            score: Confidence, or None.

        Raises:
            EvaluationError: The person has a pose at that time already.
        """
        for name in names:
            self._joints.setdefault(name, len(self._joints))
        frame = self._frames.setdefault(time, {})
        if person is None:
            self.has_identities = False
            person = str(len(frame))
        if person in frame:
            raise EvaluationError(
                f"person {person!r} has two poses at {time * 1e-9:.6f} s; give each person a name of its own",
                path=self.source,
            )
        frame[person] = names, positions
        if score is not None:
            self._scores.setdefault(time, {})[person] = score

    def build(self) -> PoseSequence:
        """Make the sequence. It may have frames without people, or no frames at all.

        Raises:
            EvaluationError: A position is impossibly far away, or all people have infinite positions.
        """
        names = tuple(self._joints)
        times = sorted(self._frames)
        people = [{who: self._pose(*pose) for who, pose in self._frames[time].items()} for time in times]
        people = [{who: pose for who, pose in frame.items() if _present(pose)} for frame in people]
        poses = (pose for frame in self._frames.values() for _, pose in frame.values())
        if not any(people) and any(np.isinf(pose).any() for pose in poses):
            raise EvaluationError("no position in it is finite", path=self.source)
        scores = [self._scores.get(time, {}) for time in times] if self._scores else None
        return PoseSequence(
            names, np.array(times, np.int64), people, scores, self.source, self.has_identities
        )

    def _pose(self, names: tuple[str, ...], positions: Array) -> Array:
        pose = np.full((len(self._joints), 3), np.nan)
        pose[[self._joints[name] for name in names]] = positions
        pose[~np.isfinite(pose).all(axis=1)] = np.nan
        if (np.abs(pose) > MAX_COORDINATE * 1000).any():  # this allows for millimetres
            raise EvaluationError("a position is more than 1000 km away", path=self.source)
        return pose


@dataclass(frozen=True)
class Latency:
    """Statistics of the time from the stamp of a frame to the arrival of the estimate, seconds."""

    median: float
    p99: float
    worst: float


@dataclass(frozen=True)
class Timing:
    """How fast, how often and how completely messages arrive (docs/evaluation.md).

    Attributes:
        latency: Latency of the estimate. None if unknown, as in recordings of lockstep.
        rate: Frames per second, from the times of arrival. None for fewer than two frames.
        messages: Number of messages with a stamp, including repeated ones.
        frames: Number of frames with an estimate (different stamps).
        duplicates: Number of messages that add no person to their frame.
        out_of_order: Number of messages that are older than the previous message of their topic.
        lost: Number of frames of the truth without an estimate, between the first and the last estimate.
        lost_share: ``lost`` as a share of the frames of the truth in this time. None without such frames.
        after: Number of frames of the truth after the last estimate. None if the truth is computed.
    """

    latency: Latency | None
    rate: float | None
    messages: int
    frames: int
    duplicates: int
    out_of_order: int
    lost: int
    lost_share: float | None
    after: int | None


def timing(truth: PoseSequence, estimate: PoseSequence) -> Timing | None:
    """Timing of an estimate. None for an estimate from a file, which has no times of arrival."""
    arrivals = estimate.arrivals
    if arrivals is None:
        return None
    seconds = float(np.ptp(arrivals.times)) * 1e-9
    frames, late = len(arrivals.times), arrivals.latencies
    lost, expected, after = _losses(truth.times, estimate.times)
    return Timing(
        latency=Latency(*np.percentile(late, [50, 99, 100]).tolist()) if len(late) else None,
        rate=(frames - 1) / seconds if seconds > 0 else None,
        messages=arrivals.messages,
        frames=frames,
        duplicates=arrivals.duplicates,
        out_of_order=arrivals.out_of_order,
        lost=lost,
        lost_share=lost / expected if expected else None,
        # a truth that is computed has no end
        after=after if truth.arrivals is not None else None,
    )


def _losses(truth: NDArray[np.int64], own: NDArray[np.int64]) -> tuple[int, int, int]:
    """Three counts of frames of the truth: frames from the first to the last estimate without an estimate
    within half a period; all frames in this time; and frames after the last estimate."""
    if not len(truth):
        return 0, 0, 0
    half = float(np.median(np.diff(truth))) / 2 if len(truth) > 1 else 0.0
    between = truth[(truth >= own[0] - half) & (truth <= own[-1] + half)]
    after = np.clip(np.searchsorted(own, between), 1, max(1, len(own) - 1))
    near = np.minimum(
        np.abs(own[after - 1] - between), np.abs(own[np.minimum(after, len(own) - 1)] - between)
    )
    return int((near > half).sum()), len(between), int((truth > own[-1] + half).sum())
