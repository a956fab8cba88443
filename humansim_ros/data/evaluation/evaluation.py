"""Compare estimated 3D poses with the true poses. The result has all metrics."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.evaluation.alignment import (
    FramePairs,
    check_axes,
    check_unit,
    match_people,
    measure_offset,
    pair_distances,
    pair_frames,
)
from humansim_ros.data.evaluation.joint_names import body_joint, limbs_of, pair_joints
from humansim_ros.data.evaluation.metrics import (
    Detections,
    acceleration_errors,
    auc,
    correct_parts,
    joint_errors,
    mean_error,
    pck,
    procrustes_aligned,
    runs,
    velocity_errors,
)
from humansim_ros.data.evaluation.pose_sequence import PoseSequence, Timing, timing
from humansim_ros.data.evaluation.tracking import TrackedFrame, TrackingScores, similarity, tracking_scores
from humansim_ros.data.messages.people import GROUND
from humansim_ros.errors import EvaluationError, warn_about
from humansim_ros.scene.truth import HIPS
from humansim_ros.types import Array, Indices

#: Largest mean joint distance of a person who counts as found, metres. The recall of [Tu 2020] uses the same.
DEFAULT_GATE = 0.5
#: Largest error of a correct joint in PCK, metres [Mehta 2017].
PCK_THRESHOLD = 0.15
#: Largest mean joint distances of a found person in AP and recall, metres [Tu 2020].
AP_THRESHOLDS = (0.025, 0.05, 0.075, 0.1, 0.125, 0.15)
#: Number of poses with the largest errors that a result lists.
WORST = 10
#: Matrix that projects positions to the floor.
_ON_FLOOR = np.diag([1.0, 1.0, 0.0])


@dataclass(frozen=True)
class FrameCounts:
    """Numbers of frames: compared, compared without an estimate, and frames of the estimate without truth.
    ``start`` and ``end`` are the first and the last compared stamp, nanoseconds."""

    compared: int
    without_estimate: int
    without_truth: int
    start: int
    end: int


@dataclass(frozen=True)
class TimeOffset:
    """Delay of the stamps of the estimate, seconds: as measured (None if unknown), and as subtracted."""

    measured: float | None
    applied: float


@dataclass(frozen=True)
class PeopleCounts:
    """Numbers of people, added up over all frames: in the truth, found, missed; and false, which are people
    of the estimate who match nobody."""

    present: int
    found: int
    missed: int
    false: int
    recall: float | None
    precision: float | None

    @classmethod
    def of(cls, present: int, found: int, false: int) -> PeopleCounts:
        """Counts with the shares that follow from them."""
        shares = share(found, present), share(found, found + false)
        return cls(present, found, present - found, false, *shares)


@dataclass(frozen=True)
class PositionErrors:
    """Errors of the joints of people who were found, metres. PCK and AUC count missed people, too."""

    mpjpe: float | None
    pa_mpjpe: float | None
    median: float | None
    p90: float | None
    p99: float | None
    worst: float | None
    pck: float | None
    auc: float | None


@dataclass(frozen=True)
class MotionErrors:
    """Mean errors of velocity in m/s and acceleration in m/s² of joints."""

    velocity: float | None
    acceleration: float | None


@dataclass(frozen=True)
class PartScores:
    """Share of correct limbs (PCP, 0 to 1): of all limbs, by limb group, and by person."""

    all: float | None
    by_limb: dict[str, float]
    by_person: dict[str, float]
    mean_of_people: float | None


@dataclass(frozen=True)
class DetectionScores:
    """Average precision (AP) and recall by distance threshold in millimetres, and the mean of all AP."""

    ap: dict[str, float | None]
    recall: dict[str, float | None]
    mean_ap: float | None


@dataclass(frozen=True)
class JointScore:
    """Errors of one joint in metres. ``bias``: mean difference (x, y, z) in ``map``."""

    mpjpe: float | None
    pa_mpjpe: float | None
    pck: float | None
    bias: tuple[float, float, float] | None


@dataclass(frozen=True)
class PersonScore:
    """Scores of one person: number of frames in the truth, number of frames where the person was found, and
    errors in metres."""

    present: int
    found: int
    mpjpe: float | None
    pa_mpjpe: float | None
    velocity: float | None


@dataclass(frozen=True)
class CameraCountScore:
    """Number and mean error (metres) of the joints that are in the images of a certain number of cameras."""

    joints: int
    mpjpe: float | None


@dataclass(frozen=True)
class WorstPose:
    """One of the poses with the largest mean error: stamp in nanoseconds, person, error in metres."""

    stamp: int
    person: str
    estimate: str
    error: float


@dataclass(frozen=True)
class Matches:
    """All M pairs of a true and an estimated person who match, in the order of the frames.

    Attributes:
        frame: (M,) index of the frame among the compared frames.
        stamp: (M,) stamp of the truth, nanoseconds.
        person: Name of each person in the truth.
        estimate_person: Name of each person in the estimate.
        truth: (M, C, 3) true joints, metres.
        estimate: (M, C, 3) estimated joints, metres.
    """

    frame: Indices
    stamp: Indices
    person: Sequence[str]
    estimate_person: Sequence[str]
    truth: Array
    estimate: Array


@dataclass(frozen=True)
class Evaluation:
    """Result of a comparison, see docs/evaluation.md. Lengths are metres, times seconds, shares 0 to 1.

    ``by_cameras`` has errors by the number of cameras with the joint in their image, if the truth is a scene.
    ``tracking`` is None if the estimate has no identities or no people. ``live`` is None for files. The
    fields from ``matches`` to ``missed_joints`` are for plots, and are left out of JSON. After ``matches``
    they are: stamps (N,) of the compared frames; people found, missed and false in each frame (N, 3); joint
    errors of all matches (M, C); the same with inf for joints that the estimate lacks; and the number of
    joints of missed people.
    """

    truth: str
    estimate: str
    joints: tuple[str, ...]
    gate: float
    frames: FrameCounts
    offset: TimeOffset
    people: PeopleCounts
    position: PositionErrors
    motion: MotionErrors
    pcp: PartScores
    detection: DetectionScores
    tracking: TrackingScores | None
    by_joint: dict[str, JointScore]
    by_person: dict[str, PersonScore]
    worst: list[WorstPose]
    live: Timing | None
    matches: Matches = field(repr=False)
    frame_times: NDArray[np.int64] = field(repr=False)
    found_by_frame: Indices = field(repr=False)
    errors: Array = field(repr=False)
    counted_errors: Array = field(repr=False)
    missed_joints: int = field(repr=False)
    by_cameras: dict[str, CameraCountScore] = field(default_factory=dict)


def evaluate_poses(
    truth: PoseSequence,
    estimate: PoseSequence,
    *,
    names: Mapping[str, str] | None = None,
    gate: float = DEFAULT_GATE,
    offset: float | None = 0.0,
) -> Evaluation:
    """Compare an estimate with the truth.

    Args:
        truth: The true poses.
        estimate: The poses to judge, in ``map``, metres.
        names: Name of a joint in the truth, by name in the estimate. If None, joints are paired by their
            names.
        gate: Largest mean joint distance of a person who counts as found, metres.
        offset: Delay of the stamps of the estimate, seconds. It is subtracted before the comparison. If None,
            the delay is measured.

    Raises:
        EvaluationError: Truth and estimate have no joint or no time in common, or differ in unit or axes.
    """
    truth, estimate = _with_common_joints(truth, estimate, names)
    estimate = estimate.delayed(-round((offset or 0.0) * 1e9))
    pairs = pair_frames(truth, estimate)
    check_unit(truth, estimate, pairs)
    check_axes(truth, estimate, pairs, gate)
    measured = measure_offset(truth, estimate)
    applied = offset or 0.0
    if offset is None and measured is not None:
        applied = measured
        estimate = estimate.delayed(-round(measured * 1e9))
        pairs = pair_frames(truth, estimate)
    elif measured is not None:
        measured += applied
    return _Comparison(truth, estimate, pairs, gate).evaluation(TimeOffset(measured, applied))


def _with_common_joints(
    truth: PoseSequence, estimate: PoseSequence, names: Mapping[str, str] | None
) -> tuple[PoseSequence, PoseSequence]:
    """Reduce truth and estimate to the joints that both have, with the names of the truth. If the estimate
    has one point per person, the truth is reduced to a point on the floor. If the estimate has no people, the
    truth keeps all joints."""
    truth = truth.checked()
    if estimate.names == (GROUND,):
        truth, estimate = _below_hips(truth), estimate.mapped(_ON_FLOOR)
    if not any(estimate.people):
        return truth, replace(estimate, names=truth.names)
    common = pair_joints(truth.names, estimate.names, names)
    joints = tuple(truth.names[t] for t, _ in common)
    truth = truth.with_joints([t for t, _ in common], joints)
    estimate = estimate.with_joints([e for _, e in common], joints)
    if not any(estimate.people):
        raise EvaluationError("none of the common joints has a finite position", path=estimate.source)
    return truth, estimate


def _below_hips(truth: PoseSequence) -> PoseSequence:
    """Reduce the truth to one point per person: on the floor below the middle of the hips."""
    try:
        people = [
            {name: below_hips(truth.names, pose) for name, pose in people.items()} for people in truth.people
        ]
    except EvaluationError as error:
        raise EvaluationError(error.message, path=truth.source) from None
    return replace(truth, names=(GROUND,), people=people)


def below_hips(names: Sequence[str], positions: Array) -> Array:
    """Point (1, 3) on the floor below the middle of the hips, in ``map``.

    Args:
        names: Names of joints or keypoints.
        positions: (J, 3) metres.

    Raises:
        EvaluationError: The names have no hips.
    """
    hips = [number for number, name in enumerate(names) if body_joint(name) in HIPS]
    if len(hips) != len(HIPS):
        raise EvaluationError(
            "the estimate has one point a person, and the truth no hips to compare it with: choose a "
            "keypoint set with hips, or none"
        )
    middle: Array = positions[hips].mean(axis=0, keepdims=True) @ _ON_FLOOR
    return middle


@dataclass(frozen=True)
class PersonErrors:
    """Errors of the people who were found, frame by frame.

    Attributes:
        frames: For each compared frame: mean joint error by true person who was found, metres.
        strangers: Names of people of the estimate who match nobody in any frame.
        false: Number of estimated people who match nobody, added up over all frames.
    """

    frames: Sequence[Mapping[str, float]]
    strangers: Sequence[str]
    false: int


def person_errors(
    truth: PoseSequence,
    estimate: PoseSequence,
    pairs: FramePairs,
    names: Mapping[str, str] | None = None,
    gate: float = DEFAULT_GATE,
) -> PersonErrors:
    """Match people as :func:`evaluate_poses` does, and compute only their errors.

    Args:
        truth, estimate, names, gate: The same as in :func:`evaluate_poses`.
        pairs: The frames to compare.

    Raises:
        EvaluationError: Truth and estimate have no joint in common, or differ in unit or axes.
    """
    truth, estimate = _with_common_joints(truth, estimate, names)
    check_unit(truth, estimate, pairs)
    check_axes(truth, estimate, pairs, gate)
    found = _Comparison(truth, estimate, pairs, gate)
    frames: list[dict[str, float]] = [{} for _ in pairs.truth]
    means = np.nanmean(found.errors, axis=1) if len(found.errors) else ()
    for frame, person, error in zip(found.matches.frame.tolist(), found.matches.person, means, strict=True):
        frames[frame][person] = float(error)
    known = {name for people in estimate.people for name in people}
    strangers = known - set(found.matches.estimate_person) if estimate.has_identities else set()
    return PersonErrors(frames, sorted(strangers), found.false)


class _Comparison:
    """Matches, errors and counts of all frames. All metrics of an evaluation are computed from them."""

    def __init__(self, truth: PoseSequence, estimate: PoseSequence, pairs: FramePairs, gate: float) -> None:
        self.truth, self.estimate, self.pairs, self.gate = truth, estimate, pairs, gate
        self.missed: dict[str, int] = defaultdict(int)
        self.missed_joints = np.zeros(len(truth.names), np.intp)
        self.false = 0
        self.tracked: list[TrackedFrame] = []
        self.found_by_frame = np.zeros((len(pairs.truth), 3), np.intp)
        self._detections: list[tuple[float, float, int]] = []
        self._people = 0
        self._numbers: tuple[dict[str, int], dict[str, int]] = ({}, {})
        rows: list[tuple[int, int, str, str, Array, Array]] = []
        for frame, (t, e) in enumerate(zip(pairs.truth.tolist(), pairs.estimate.tolist(), strict=True)):
            for person, own in self._match(frame, t, e):
                poses = truth.people[t][person], estimate.people[e][own]
                rows.append((frame, int(truth.times[t]), person, own, *poses))
        columns: Sequence[Sequence[Any]] = list(zip(*rows, strict=True)) or [()] * 6
        frames, stamps, people, names = columns[:4]
        true, found = (np.reshape(np.array(each, float), (-1, len(truth.names), 3)) for each in columns[4:])
        self.matches = Matches(
            np.array(frames, np.intp), np.array(stamps, np.int64), people, names, true, found
        )
        self.errors = joint_errors(self.matches.truth, self.matches.estimate)
        aligned = procrustes_aligned(self.matches.truth, self.matches.estimate)
        self.aligned_errors = joint_errors(self.matches.truth, aligned)

    def _match(self, frame: int, t: int, e: int) -> list[tuple[str, str]]:
        """Match and count people of frames ``t`` (truth) and ``e`` (estimate). Returns pairs of names."""
        truth = self.truth.people[t]
        estimate = self.estimate.people[e] if e >= 0 else {}
        people, own = list(truth), list(estimate)
        distances = pair_distances(list(truth.values()), list(estimate.values()))
        found = match_people(distances, self.gate)
        for index in set(range(len(people))) - {row for row, _ in found}:
            self.missed[people[index]] += 1
            self.missed_joints += np.isfinite(truth[people[index]]).all(axis=1)
        self.false += len(own) - len(found)
        self.found_by_frame[frame] = len(found), len(people) - len(found), len(own) - len(found)
        numbers = [
            np.array([table.setdefault(name, len(table)) for name in names], np.intp)
            for table, names in zip(self._numbers, (people, own), strict=True)
        ]
        self.tracked.append(TrackedFrame(numbers[0], numbers[1], similarity(distances, self.gate)))
        scores = self.estimate.scores[e] if self.estimate.scores is not None and e >= 0 else {}
        for column, name in enumerate(own):
            nearest = int(np.argmin(distances[:, column])) if people else -1
            distance = float(distances[nearest, column]) if people else np.inf
            self._detections.append((scores.get(name, 0.0), distance, self._people + nearest))
        self._people += len(people)
        return [(people[row], own[column]) for row, column in found]

    def evaluation(self, offset: TimeOffset) -> Evaluation:
        """All metrics."""
        times, found = self.truth.times[self.pairs.truth], len(self.matches.frame)
        if not self.estimate.count:
            warn_about(self.estimate.source, "nobody is in the estimate: everybody is missed")
        elif not found:
            warn_about(
                self.estimate.source,
                f"no person of the estimate is within {self.gate:g} m of the truth; are both in map?",
            )
        return Evaluation(
            truth=self.truth.source,
            estimate=self.estimate.source,
            joints=self.truth.names,
            gate=self.gate,
            frames=FrameCounts(
                len(times),
                int((self.pairs.estimate < 0).sum()),
                self.pairs.without_truth,
                int(times[0]),
                int(times[-1]),
            ),
            offset=offset,
            people=PeopleCounts.of(found + sum(self.missed.values()), found, self.false),
            position=self._position(),
            motion=self._motion(None),
            pcp=self._parts(),
            detection=self._detection(),
            tracking=self._tracking(),
            by_joint={name: self._joint(index) for index, name in enumerate(self.truth.names)},
            by_person={name: self._person(name) for name in self._numbers[0]},
            worst=self._worst(),
            live=timing(self.truth, self.estimate),
            matches=self.matches,
            frame_times=times,
            found_by_frame=self.found_by_frame,
            errors=self.errors,
            counted_errors=self._counted_errors(),
            missed_joints=int(self.missed_joints.sum()),
        )

    def _counted_errors(self) -> Array:
        """Joint errors (M, C), with inf for joints that the truth has but the estimate lacks."""
        absent = np.isfinite(self.matches.truth).all(axis=2) & np.isnan(self.errors)
        return np.where(absent, np.inf, self.errors)

    def _position(self) -> PositionErrors:
        known = self.errors[np.isfinite(self.errors)]
        median, p90, p99, worst = (
            float(np.percentile(known, share)) if len(known) else None for share in (50, 90, 99, 100)
        )
        errors, missing = self._counted_errors(), int(self.missed_joints.sum())
        return PositionErrors(
            mpjpe=mean_error(self.errors),
            pa_mpjpe=mean_error(self.aligned_errors),
            median=median,
            p90=p90,
            p99=p99,
            worst=worst,
            pck=pck(errors, PCK_THRESHOLD, missing),
            auc=auc(errors, missing),
        )

    def _of_person(self, name: str) -> Indices:
        return np.flatnonzero(np.array([person == name for person in self.matches.person], dtype=bool))

    def _motion(self, person: str | None) -> MotionErrors:
        """Errors of velocity and acceleration of one person, or of all people if None. They are computed
        within parts of a track without a gap or a change of identity."""
        velocity, acceleration = [np.zeros(0)], [np.zeros(0)]
        matches = self.matches
        groups: dict[tuple[str, str], list[int]] = defaultdict(list)
        for index, key in enumerate(zip(matches.person, matches.estimate_person, strict=True)):
            if person in (None, key[0]):
                groups[key].append(index)
        times = self.truth.times[self.pairs.truth]
        most = 1.5 * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
        for indices in groups.values():
            for run in runs(matches.stamp[indices], most):
                rows = indices[run]
                seconds = (matches.stamp[rows] - matches.stamp[rows[0]]) * 1e-9
                truth, estimate = matches.truth[rows], matches.estimate[rows]
                velocity.append(velocity_errors(seconds, truth, estimate).ravel())
                acceleration.append(acceleration_errors(seconds, truth, estimate).ravel())
        return MotionErrors(mean_error(np.concatenate(velocity)), mean_error(np.concatenate(acceleration)))

    def _parts(self) -> PartScores:
        groups, limbs = limbs_of(self.truth.names)
        correct = correct_parts(self.matches.truth, self.matches.estimate, limbs)
        right: dict[str, int] = defaultdict(int)
        total: dict[str, int] = defaultdict(int)
        by_person: dict[str, float] = {}
        for name in self._numbers[0]:
            rows = self._of_person(name)
            own_right = own_total = 0
            for column, group in enumerate(groups):
                hits = int((correct[rows, column] == 1).sum())
                count = int((correct[rows, column] >= 0).sum()) + self.missed[name]
                right[group] += hits
                total[group] += count
                own_right, own_total = own_right + hits, own_total + count
            if own_total:
                by_person[name] = own_right / own_total
        return PartScores(
            all=share(sum(right.values()), sum(total.values())),
            by_limb={group: right[group] / total[group] for group in total if total[group]},
            by_person=by_person,
            mean_of_people=float(np.mean(list(by_person.values()))) if by_person else None,
        )

    def _detection(self) -> DetectionScores:
        table = np.array(self._detections, float).reshape(-1, 3)
        found = Detections(table[:, 0], table[:, 1], table[:, 2].astype(np.intp), self._people)
        aps = {_mm(t): found.average_precision(t) for t in AP_THRESHOLDS}
        values = [ap for ap in aps.values() if ap is not None]
        return DetectionScores(
            ap=aps,
            recall={_mm(t): found.recall(t) for t in (*AP_THRESHOLDS, DEFAULT_GATE)},
            mean_ap=float(np.mean(values)) if values else None,
        )

    def _tracking(self) -> TrackingScores | None:
        if not self.estimate.has_identities or not all(self._numbers):
            return None
        return tracking_scores(self.tracked)

    def _joint(self, index: int) -> JointScore:
        errors = self.errors[:, index]
        found = np.isfinite(errors)
        difference = (self.matches.estimate[:, index] - self.matches.truth[:, index])[found]
        x, y, z = difference.mean(axis=0).tolist() if found.any() else (np.nan,) * 3
        return JointScore(
            mpjpe=mean_error(errors),
            pa_mpjpe=mean_error(self.aligned_errors[:, index]),
            pck=pck(self._counted_errors()[:, index], PCK_THRESHOLD, int(self.missed_joints[index])),
            bias=(x, y, z) if found.any() else None,
        )

    def _person(self, name: str) -> PersonScore:
        rows = self._of_person(name)
        return PersonScore(
            present=len(rows) + self.missed[name],
            found=len(rows),
            mpjpe=mean_error(self.errors[rows]),
            pa_mpjpe=mean_error(self.aligned_errors[rows]),
            velocity=self._motion(name).velocity,
        )

    def _worst(self) -> list[WorstPose]:
        count = np.isfinite(self.errors).sum(axis=1)
        mean = np.nansum(self.errors, axis=1) / np.maximum(count, 1)
        order = np.argsort(-mean, kind="stable")[:WORST]
        matches = self.matches
        return [
            WorstPose(int(matches.stamp[i]), matches.person[i], matches.estimate_person[i], float(mean[i]))
            for i in order
        ]


def share(part: int, whole: int) -> float | None:
    """``part / whole``; None if ``whole`` is 0."""
    return part / whole if whole else None


def _mm(metres: float) -> str:
    return f"{metres * 1000:g}"
