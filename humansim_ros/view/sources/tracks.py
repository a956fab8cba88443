"""Tracks of the timeline of a page: keyframes, drops, joints, visibility and errors over all frames.

The tracks are read frame by frame in another process with a lower priority than images, so that neither
images nor poses of the page wait for tracks. ``humansim_ros.scene`` decides what is visible, at the full size
of cameras; ``humansim_ros.data.evaluation`` decides which people of an estimate are matched, and what their
errors are.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.engine import JobProcesses, ProcessDiedError, ProcessJob
from humansim_ros.data.evaluation import (
    FramePairs,
    LiveOptions,
    PersonErrors,
    PoseSequence,
    pair_frames,
    person_errors,
    truth_at,
)
from humansim_ros.errors import EvaluationError, HumansimError, printable, some_of
from humansim_ros.motion.body import body_joints
from humansim_ros.motion.files import KeyframeTrack
from humansim_ros.scene.config import FIRST_STAMP
from humansim_ros.scene.core import Needs, Playback, Scene, Simulation
from humansim_ros.scene.truth import OCCLUDED, REQUIRED_CHANNELS, VISIBLE
from humansim_ros.types import Float32Array, Indices

_LOG = logging.getLogger(__name__)
#: Most frames in which joints are read or an estimate is compared; most frames with visibility.
MOST_MOTION, _MOST_VIEWS = 600, 120
#: Most marks of a track. More would fall on the same columns of pixels.
_MOST_MARKS = 2000
#: Number of frames in one request for joints.
_CHUNK = 30
#: Niceness of the process, relative to the page. Images have 5, and so a higher priority.
_NICE = 10
#: A source must be shown for this number of seconds before its tracks are read, since an editor changes the
#: source several times. Then the reader waits for the first images, but at most the second number of seconds.
_QUIET, _PATIENCE = 1.0, 20.0
#: For a running graph: time that the timeline shows, and time between two frames in which joints and
#: visibility are read, nanoseconds; most frames.
_LIVE_SPAN, _LIVE_STEP, _MOST_LIVE = 60 * 10**9, 240_000_000, 6000
#: Seconds between two checks for answers of the process, and between two updates of the page.
_TICK, _PUBLISH = 0.2, 0.7


@dataclass(frozen=True)
class TrackOutline:
    """Content of a timeline that is known before any frame is read. Frames are given by their numbers.

    Attributes:
        frames: Number of frames.
        period: Nanoseconds between frames.
        cameras: Names of the cameras.
        joints: Names of the joints by person.
        spans: First and last frame of each interval in which a person is there, by person.
        keys: Frames that have a keyframe, by person or object. Those without keyframes are absent.
        drops: Frames with a lost image, by camera. Cameras without lost images are absent.
        projected: Cameras whose data do not tell which joints are occluded, so that joints are projected.
        has_views: Whether the visibility of joints can be read.
        most_views: Most frames in which visibility is read.
        has_errors: Whether there is an estimate.
    """

    frames: int
    period: int
    cameras: Sequence[str] = ()
    joints: Mapping[str, Sequence[str]] = field(default_factory=dict)
    spans: Mapping[str, Sequence[tuple[int, int]]] = field(default_factory=dict)
    keys: Mapping[str, Sequence[int]] = field(default_factory=dict)
    drops: Mapping[str, Sequence[int]] = field(default_factory=dict)
    projected: Sequence[str] = ()
    has_views: bool = True
    most_views: int = _MOST_VIEWS
    has_errors: bool = False


@dataclass(frozen=True)
class TrackSample:
    """Values of the tracks in one frame.

    Attributes:
        joints: Positions (J, 3) in ``map`` by person, metres, in the order of :attr:`TrackOutline.joints`.
        seen: Shares of visible and of occluded joints, by person and camera. The rest is outside the image.
    """

    joints: Mapping[str, Float32Array] = field(default_factory=dict)
    seen: Mapping[str, Mapping[str, tuple[float, float]]] = field(default_factory=dict)


@dataclass(frozen=True)
class ErrorTrack:
    """Errors of an estimate of a tracker over time.

    Attributes:
        frames: Numbers of the compared frames.
        errors: For each compared frame, mean distance of the joints from the truth by person, millimetres.
            People whom the estimate lacks are absent.
        note: Message for the user about the estimate; empty if there is none.
    """

    frames: Sequence[int] = ()
    errors: Sequence[Mapping[str, float]] = ()
    note: str = ""


class TrackWorker(Protocol):
    """Reads the tracks of a source. It runs in a process of its own."""

    def outline(self) -> TrackOutline:
        """Return what is known without reading frames."""

    def motion(self, index: int) -> TrackSample:
        """Read the positions of the joints in a frame."""

    def views(self, index: int) -> TrackSample:
        """Read the visibility of the joints in a frame."""

    def errors(self) -> ErrorTrack:
        """Compute the errors of the estimate. Raises EvaluationError if it cannot be compared."""

    def close(self) -> None:
        """Close files and renderers."""


def seen_shares(visible: NDArray[np.uint8]) -> tuple[float, float]:
    """Shares of visible and of occluded joints. ``visible``: states (J,) of the joints in a camera."""
    if not len(visible):
        return 0.0, 0.0
    return float(np.mean(visible == VISIBLE)), float(np.mean(visible == OCCLUDED))


def coarse_to_fine(frames: int, most: int) -> list[int]:
    """At most ``most`` evenly spaced frame numbers, coarse to fine: first and last, then the middles."""
    chosen = np.unique(np.linspace(0, frames - 1, min(frames, most)).round().astype(int)).tolist()
    order: dict[int, None] = dict.fromkeys((0, len(chosen) - 1))
    for power in reversed(range(len(chosen).bit_length())):
        order |= dict.fromkeys(range(0, len(chosen), 1 << power))
    return [chosen[place] for place in order]


# --- errors of an estimate


@dataclass(frozen=True)
class ErrorPlan:
    """Frames of a page in which an estimate is compared with the truth, or in which the estimate has a gap.

    Attributes:
        frames: (N,) increasing numbers of these frames; at most :data:`MOST_MOTION`.
        own: (N,) int64 stamps of the estimate in these frames, nanoseconds; -1 in a gap.
        last: Number of the last frame of the page.
        options: How the estimate is compared.
        estimate: Poses of the estimate in these frames. If None, they are read later.
        problem: Why the estimate cannot be compared; empty if it can.
    """

    frames: Indices
    own: NDArray[np.int64]
    last: int
    options: LiveOptions
    estimate: PoseSequence | None = None
    problem: str = ""

    @classmethod
    def of(
        cls, stamps: NDArray[np.int64], estimate: PoseSequence | NDArray[np.int64], options: LiveOptions
    ) -> ErrorPlan:
        """Pair frames of page and estimate as ``humansim evaluate`` does, and choose some at even distances.

        Args:
            stamps: (F,) increasing stamps of the frames of the page, nanoseconds.
            estimate: The estimate; or only its increasing stamps, if its poses are read later.
            options: How the estimate is compared.
        """
        given = estimate if isinstance(estimate, PoseSequence) else None
        own = estimate.times if isinstance(estimate, PoseSequence) else estimate
        last = len(stamps) - 1
        none = np.zeros(0, np.intp)
        if not len(own):
            return cls(none, none.astype(np.int64), last, options, problem="the estimate has no poses")
        try:
            pairs = pair_frames(PoseSequence((), stamps, ()), PoseSequence((), own, ()))
        except EvaluationError as error:
            return cls(none, none.astype(np.int64), last, options, problem=error.message)
        chosen = np.sort(coarse_to_fine(len(pairs.truth), MOST_MOTION))
        rows = pairs.estimate[chosen]
        if given is not None:
            kept = rows[rows >= 0].tolist()
            people = [given.people[row] for row in kept]
            given = replace(given, times=own[kept], people=people, scores=None, arrivals=None)
        return cls(pairs.truth[chosen], np.where(rows < 0, -1, own[rows]), last, options, given)

    def compare(self, truth: PoseSequence, estimate: PoseSequence) -> ErrorTrack:
        """Compare an estimate with the truth in the planned frames.

        Args:
            truth: True poses in the N frames.
            estimate: Poses of the estimate at the stamps ``own``; some may be missing.

        Raises:
            EvaluationError: Truth and estimate have no joint in common, or seem to differ in unit or axes.
        """
        rows = np.searchsorted(estimate.times, self.own)
        rows = np.where(rows < len(estimate.times), rows, 0)
        rows = np.where(estimate.times[rows] == self.own, rows, -1)
        options = self.options
        pairs = FramePairs(np.arange(len(self.frames)), rows, 0)
        found = person_errors(truth, estimate, pairs, options.table, options.gate)
        frames = dict(zip(self.frames.tolist(), found.frames, strict=True))
        # before the first and after the last compared frame, nothing is known
        around: dict[int, dict[str, float]] = {int(self.frames[0]) - 1: {}, int(self.frames[-1]) + 1: {}}
        frames |= {index: none for index, none in around.items() if 0 <= index <= self.last}
        errors = {k: {name: 1000.0 * error for name, error in frames[k].items()} for k in sorted(frames)}
        return ErrorTrack(list(errors), list(errors.values()), _note(found, options.gate))


def _note(found: PersonErrors, gate: float) -> str:
    """Message for the user about people of an estimate who match nobody; empty if there is none."""
    if not any(found.frames):
        return f"no person of the estimate is within {gate:g} m of the truth; are both in map?"
    if found.strangers:
        names = some_of([printable(name, 60) for name in found.strangers], 5)
        return f"people of the estimate who are within {gate:g} m of nobody of the truth: {names}"
    if found.false:
        return f"people of the estimate are {found.false} times within {gate:g} m of nobody of the truth"
    return ""


# --- a scene


@dataclass(frozen=True)
class SceneTracks:
    """Job that computes the tracks of a scene, in another process.

    Attributes:
        scene: The scene.
        frames: Number of frames of the page.
        cameras: Names of the cameras of the page.
        plan: Frames in which an estimate is compared with the truth; None if there is no estimate.
    """

    scene: Scene
    frames: int
    cameras: Sequence[str]
    plan: ErrorPlan | None = None

    def start(self) -> Tracker:
        """Start the simulation, in the process that reads the tracks."""
        return Tracker(_SceneTracks(self))


class _SceneTracks:
    def __init__(self, job: SceneTracks) -> None:
        self._job, self._scene = job, job.scene
        self._playback = Playback(job.scene)
        self._simulation: Simulation | None = None

    def outline(self) -> TrackOutline:
        job, scene = self._job, self._scene
        moved = {name: actor.keyframes for name, actor in scene.actors.items()}
        moved |= {name: item.keyframes for name, item in scene.objects.items()}
        lost = {
            name: [
                index
                for index in range(job.frames if scene.scene_cameras[name].faults else 0)
                if (faults := scene.scene_cameras[name].faults) and not faults.at(index).sent
            ]
            for name in job.cameras
        }
        return TrackOutline(
            frames=job.frames,
            period=round(1e9 / scene.config.rate),
            cameras=tuple(job.cameras),
            joints={name: actor.human.skeleton.joint_names for name, actor in scene.actors.items()},
            spans={name: [(0, job.frames - 1)] for name in scene.actors},
            keys={
                name: key_frames(track, scene.config.rate, job.frames)
                for name, track in moved.items()
                if track is not None
            },
            drops={name: frames for name, frames in lost.items() if frames},
            has_views=bool(job.cameras and scene.actors),
            has_errors=job.plan is not None,
        )

    def motion(self, index: int) -> TrackSample:
        poses = self._playback.show(self._scene.frame_time(index)).motions
        actors = self._playback.actors
        joints = {name: actor.posed(poses[name].contiguous()).bones[0] for name, actor in actors.items()}
        return TrackSample({name: each[:, :3, 3].astype(np.float32) for name, each in joints.items()})

    def views(self, index: int) -> TrackSample:
        if self._simulation is None:
            self._simulation = Simulation(self._scene)
        frame = self._simulation.frame(index, Needs(REQUIRED_CHANNELS["joints"], self._job.cameras))
        seen: dict[str, dict[str, tuple[float, float]]] = {}
        for camera, truth in frame.truth.items():
            for person, joints in truth.joints.items():
                body = body_joints(self._scene.actors[person].human.skeleton.joint_names)
                seen.setdefault(person, {})[camera] = seen_shares(joints.visible[body])
        return TrackSample(seen=seen)

    def errors(self) -> ErrorTrack:
        plan = self._job.plan
        if plan is None or plan.estimate is None or plan.problem:
            return ErrorTrack(note="" if plan is None else plan.problem)
        times = np.array([self._scene.frame_time(index) for index in plan.frames.tolist()], np.int64)
        truth = truth_at(self._scene, times, FIRST_STAMP + times, plan.options.keypoints)
        return plan.compare(truth, plan.estimate)

    def close(self) -> None:
        if self._simulation is not None:
            self._simulation.close()


def key_frames(track: KeyframeTrack, rate: float, frames: int) -> list[int]:
    """Frames of a page (``rate`` per second) nearest to the keys of a track and their repetitions."""
    timeline = track.timeline
    seconds = (track.frames - timeline.start) / timeline.rate
    repeats = timeline.loop == "repeat" and timeline.duration > 0
    rounds = int(np.ceil(frames / rate / timeline.duration)) if repeats else 1
    starts = np.arange(max(1, min(rounds, frames))) * timeline.duration
    found = np.rint((starts[:, None] + seconds).ravel() * rate).astype(int)
    return np.unique(found[found < frames]).tolist()


# --- in the other process


@dataclass(frozen=True)
class _Asked:
    """A request to a :class:`Tracker`. ``kind`` is ``outline``, ``errors``, ``motion`` or ``views``."""

    source: int
    kind: str
    frames: tuple[int, ...] = ()


class Tracker:
    """Answers requests of the page in the other process, with a worker."""

    def __init__(self, worker: TrackWorker) -> None:
        self._worker = worker

    def work(self, asked: _Asked) -> Any:
        """Answer a request. Errors of the comparison with an estimate become a note."""
        if asked.kind == "outline":
            return self._worker.outline()
        if asked.kind == "errors":
            try:
                return self._worker.errors()
            except EvaluationError as error:  # the other tracks are shown all the same
                return ErrorTrack(note=error.message)
        read = self._worker.motion if asked.kind == "motion" else self._worker.views
        return {index: read(index) for index in asked.frames}

    def close(self) -> None:
        """Close the worker."""
        self._worker.close()


# --- in the process of the page


class Tracks:
    """Tracks of a source. They grow while frames are read."""

    def __init__(self, outline: TrackOutline) -> None:
        self.outline = outline
        self._motion: dict[int, TrackSample] = {}
        self._views: dict[int, TrackSample] = {}
        self.errors = ErrorTrack()
        self.motion_plan = coarse_to_fine(outline.frames, MOST_MOTION) if outline.joints else []
        self.views_plan = coarse_to_fine(outline.frames, outline.most_views) if outline.has_views else []

    def take(self, kind: str, samples: Mapping[int, TrackSample]) -> None:
        """Add values, by number of the frame. ``kind``: ``motion`` (joints) or ``views`` (visibility)."""
        (self._motion if kind == "motion" else self._views).update(samples)

    @property
    def is_whole(self) -> bool:
        """Whether all planned frames have been read."""
        return len(self._views) == len(self.views_plan) and len(self._motion) == len(self.motion_plan)

    def table(self) -> dict[str, Any]:
        """Tracks (without joint positions) as plain data for the script of the page (``page/timeline.js``).

        ``visible`` and ``occluded`` have, by person and camera, the percentage of joints in each frame of
        ``sampled``. ``errors`` has millimetres by person for its own list ``frames``. Missing values are
        None. ``drops`` of long recordings are thinned out; ``dropped`` counts all lost images.
        """
        outline, sampled = self.outline, sorted(self._views)
        samples = [self._views[index] for index in sampled]

        def shares(person: str, camera: str, which: int) -> list[int | None]:
            found = (each.seen.get(person, {}).get(camera) for each in samples)
            return [None if pair is None else round(100 * pair[which]) for pair in found]

        people = list(outline.joints)
        seen = people if outline.has_views else []
        spans = {name: _joined(outline.spans.get(name, ()), outline.frames) for name in people}
        return {
            "frames": outline.frames,
            "period": outline.period * 1e-9,
            "cameras": list(outline.cameras),
            "projected": list(outline.projected),
            "people": [{"name": name, "spans": spans[name]} for name in people],
            "joints": {name: list(joints) for name, joints in outline.joints.items()},
            "keys": {name: list(keys) for name, keys in outline.keys.items()},
            "drops": {name: _thinned(frames, outline.frames) for name, frames in outline.drops.items()},
            "dropped": {name: len(frames) for name, frames in outline.drops.items()},
            "sampled": sampled,
            "planned": len(self.views_plan),
            "curves": len(self.motion_plan),
            "visible": {name: {c: shares(name, c, 0) for c in outline.cameras} for name in seen},
            "occluded": {name: {c: shares(name, c, 1) for c in outline.cameras} for name in seen},
            "errors": {
                "frames": list(self.errors.frames),
                "values": {
                    name: [
                        None if (error := each.get(name)) is None else round(error, 1)
                        for each in self.errors.errors
                    ]
                    for name in (people if outline.has_errors else ())
                },
            },
            "problem": self.errors.note,
        }

    def curve(self, person: str, joint: str) -> dict[str, Any] | None:
        """Positions of a joint in ``map``, metres, in the frames read so far; None if it does not exist."""
        names = list(self.outline.joints.get(person, ()))
        if joint not in names:
            return None
        number = names.index(joint)
        found = {k: each.joints[person][number] for k, each in self._motion.items() if person in each.joints}
        frames = sorted(frames for frames, point in found.items() if np.isfinite(point).all())
        lines = {
            axis: [round(float(found[index][place]), 4) for index in frames]
            for place, axis in enumerate(("x", "y", "z"))
        }
        return {"person": person, "joint": joint, "frames": frames, "lines": lines}


def _thinned(frames: Sequence[int], count: int) -> list[int]:
    """Thin out the numbers ``frames`` of a recording of ``count`` frames, to ``_MOST_MARKS`` at most."""
    if len(frames) <= _MOST_MARKS:
        return list(frames)
    _, first = np.unique(np.asarray(frames) * _MOST_MARKS // count, return_index=True)
    return np.asarray(frames)[first].tolist()


def _joined(spans: Sequence[tuple[int, int]], count: int) -> list[tuple[int, int]]:
    """Spans of a recording of ``count`` frames. If there are many, invisibly small gaps are closed."""
    if len(spans) <= _MOST_MARKS:
        return list(spans)
    found = [spans[0]]
    for first, end in spans[1:]:
        if first - found[-1][1] <= count // _MOST_MARKS:
            found[-1] = found[-1][0], end
        else:
            found.append((first, end))
    return found


class TrackReader:
    """Reads the tracks of the timeline of a page in a background process, for the source that the page shows.

    Args:
        publish: Function that is called in another thread whenever more tracks have been read, with the
            number of the source (from :meth:`show`) and the tracks so far; or, if reading fails, a text with
            the reason instead of the tracks.
    """

    def __init__(self, publish: Callable[[int, Tracks | str], None]) -> None:
        self._publish = publish
        self._condition = threading.Condition()
        self._number, self._since = 0, 0.0
        self._job: ProcessJob | None = None
        self._is_ready = self._has_ended = False
        self._thread: threading.Thread | None = None

    def show(self, job: ProcessJob | None) -> int:
        """Read the tracks of another source once :meth:`begin` is called. If ``job`` is None, there are none.

        Returns:
            Number of the source, which ``publish`` gets.
        """
        with self._condition:
            self._number, self._job, self._since = self._number + 1, job, time.monotonic()
            self._is_ready = False
            self._condition.notify_all()
            return self._number

    def begin(self) -> None:
        """Start to read the tracks. The page calls this when it has its first images."""
        if self._is_ready:
            return
        with self._condition:
            self._is_ready = True
            self._condition.notify_all()
            if self._thread is None and self._job is not None:
                self._thread = threading.Thread(target=self._run, name="tracks", daemon=True)
                self._thread.start()

    def close(self) -> None:
        """End the thread and its process."""
        with self._condition:
            self._has_ended = True
            self._condition.notify_all()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        workers: JobProcesses | None = None
        read = 0
        while (found := self._next(read)) is not None:
            read, job = found
            try:
                if workers is None:
                    workers = JobProcesses(job, 1, _NICE)
                else:
                    workers.use(job)
                self._read(workers, read)
            except Exception as error:
                is_known = isinstance(error, HumansimError)
                if not is_known:
                    _LOG.exception("the tracks of the timeline could not be read")
                if workers is not None and (isinstance(error, ProcessDiedError) or not is_known):
                    workers.close()
                    workers = None
                self._publish(read, str(error) if is_known else f"they could not be read: {error!r}")
        if workers is not None:
            workers.close()

    def _next(self, read: int) -> tuple[int, ProcessJob] | None:
        """Wait for the next source to read. Returns its number and job; None after :meth:`close`."""
        with self._condition:
            while not self._has_ended:
                left = self._since + (_QUIET if self._is_ready else _PATIENCE) - time.monotonic()
                if self._job is None or self._number == read:
                    self._condition.wait()
                elif left > 0:
                    self._condition.wait(left)
                else:
                    return self._number, self._job
        return None

    def _is_replaced(self, number: int) -> bool:
        return self._has_ended or number != self._number

    def _read(self, workers: JobProcesses, number: int) -> None:
        outline = self._answer(workers, _Asked(number, "outline"))
        if outline is None:
            return
        tracks = Tracks(outline)
        self._publish(number, tracks)
        published = time.monotonic()
        motion, views = tracks.motion_plan, tracks.views_plan
        chunks = [("motion", tuple(motion[i : i + _CHUNK])) for i in range(0, len(motion), _CHUNK)]
        errors: list[tuple[str, tuple[int, ...]]] = [("errors", ())] if outline.has_errors else []
        for kind, frames in [*chunks, *errors, *(("views", (index,)) for index in views)]:
            samples = self._answer(workers, _Asked(number, kind, frames))
            if samples is None:
                return
            if kind == "errors":
                tracks.errors = samples
            else:
                tracks.take(kind, samples)
            if time.monotonic() - published > _PUBLISH:
                self._publish(number, tracks)
                published = time.monotonic()
        self._publish(number, tracks)

    def _answer(self, workers: JobProcesses, asked: _Asked) -> Any:
        """Wait for the answer to a request; None if the source has been replaced meanwhile."""
        sent = False
        while not self._is_replaced(asked.source):
            sent = sent or workers.ask(asked)
            found = dict(workers.arrived(_TICK))
            answer = found.get(asked)
            if isinstance(answer, HumansimError):
                raise answer
            if answer is not None:
                return answer
        return None


def spans_of(present: Iterable[bool]) -> list[tuple[int, int]]:
    """First and last frame of each interval in which ``present`` (one value per frame) is true."""
    flags = np.concatenate([[False], np.fromiter(present, bool), [False]])
    edges = np.flatnonzero(flags[1:] != flags[:-1]).reshape(-1, 2)
    return [(int(first), int(last) - 1) for first, last in edges]


def has_message(stamps: NDArray[np.int64], own: NDArray[np.int64], half: int) -> NDArray[np.bool_]:
    """Whether each frame (F,) has a message: one with a stamp within half a period of the frame.

    Args:
        stamps: (F,) stamps of the frames, nanoseconds.
        own: (N,) increasing stamps of the messages.
        half: Half a period of the frames, nanoseconds.
    """
    if not len(own):
        return np.zeros(len(stamps), bool)
    after = np.searchsorted(own, stamps)
    before, after = own[np.maximum(after - 1, 0)], own[np.minimum(after, len(own) - 1)]
    return np.asarray(np.minimum(abs(stamps - before), abs(after - stamps)) <= half)


def lost_frames(present: NDArray[np.bool_]) -> list[int]:
    """Numbers of frames with a lost image: missing images between two that are farther apart than usual.
    ``present``: (F,) whether a frame has an image."""
    having = np.flatnonzero(present)
    steps = np.diff(having)
    if not len(steps):
        return []
    step = max(1, round(float(np.median(steps))))
    found: list[int] = []
    for place in np.flatnonzero(steps > step).tolist():
        found += range(int(having[place]) + step, int(having[place + 1]) - step + 1, step)
    return found


# --- a running graph


@dataclass(frozen=True)
class ArrivedFrame:
    """Messages of a running graph that have arrived for a frame.

    Attributes:
        stamp: Nanoseconds.
        people: Names of the people with joints that have arrived.
        images: Whether the image of a camera has arrived, by camera; only cameras with a subscribed image.
        sample: Joints and visibility; None if they were not read in this frame.
        projected: Cameras for which the joints of the sample were projected, so that none counts as occluded.
        errors: Errors of an estimate by person, millimetres.
    """

    stamp: int
    people: frozenset[str]
    images: Mapping[str, bool]
    sample: TrackSample | None = None
    projected: Collection[str] = ()
    errors: Mapping[str, float] = field(default_factory=dict)


class LiveTracks:
    """Tracks of a running graph, which cover only its newest frames.

    Attributes:
        newest: Stamp of the newest frame, nanoseconds; -1 without frames.
    """

    def __init__(self) -> None:
        self._frames: deque[ArrivedFrame] = deque(maxlen=_MOST_LIVE)

    @property
    def newest(self) -> int:
        """Stamp of the newest frame in nanoseconds, -1 if none has arrived."""
        return self._frames[-1].stamp if self._frames else -1

    def wants_sample(self, stamp: int) -> bool:
        """Whether it is time to read joints and visibility again, in the frame at ``stamp``."""
        last = next((each.stamp for each in reversed(self._frames) if each.sample is not None), None)
        return last is None or stamp - last >= _LIVE_STEP

    def add(self, frame: ArrivedFrame) -> None:
        """Add a frame. Frames that are too old, or of an earlier run (later stamps), are removed."""
        if frame.stamp <= self.newest:
            self._frames.clear()
        self._frames.append(frame)
        while frame.stamp - self._frames[0].stamp > _LIVE_SPAN:
            self._frames.popleft()

    def tracks(
        self,
        period: int,
        joints: Mapping[str, Sequence[str]],
        cameras: Sequence[str],
        projected: Sequence[str] = (),
        has_errors: bool = False,
    ) -> Tracks:
        """Return the tracks of the present frames. Frame 0 is the oldest frame.

        Args:
            period: Nanoseconds between frames.
            joints: Names of the joints by person.
            cameras: Names of the cameras.
            projected: Cameras whose data do not tell which joints are occluded.
            has_errors: Whether there is an estimate.
        """
        frames = list(self._frames)
        first = frames[0].stamp if frames else 0
        numbers = [round((each.stamp - first) / period) for each in frames]
        count = numbers[-1] + 1 if numbers else 1
        drops = {name: _lost_of(name, frames, numbers) for name in cameras}
        outline = TrackOutline(
            frames=count,
            period=period,
            cameras=tuple(cameras),
            joints=joints,
            spans={name: _spans_at(numbers, [name in each.people for each in frames]) for name in joints},
            drops={name: lost for name, lost in drops.items() if lost},
            projected=projected,
            has_views=bool(cameras and joints),
            has_errors=has_errors,
        )
        sampled = [(number, each) for number, each in zip(numbers, frames, strict=True) if each.sample]
        found = Tracks(outline)
        for number, each in sampled:
            assert each.sample is not None
            posed = {name: pose for name, pose in each.sample.joints.items()
                     if len(pose) == len(joints.get(name, ()))}  # fmt: skip
            # if a camera now tells what is occluded, earlier projections are not shown
            old = set(each.projected) - set(projected)
            seen = {
                person: {name: shares for name, shares in of_person.items() if name not in old}
                for person, of_person in each.sample.seen.items()
            }
            found.take("motion", {number: TrackSample(posed)})
            found.take("views", {number: TrackSample(seen=seen)})
        if has_errors:
            found.errors = ErrorTrack([number for number, _ in sampled], [each.errors for _, each in sampled])
        return found


def _lost_of(camera: str, frames: Sequence[ArrivedFrame], numbers: Sequence[int]) -> list[int]:
    """Numbers of the frames in which an image of a camera was lost, while its images were subscribed."""
    found: list[int] = []
    for first, last in spans_of(camera in each.images for each in frames):
        present = np.array([each.images[camera] for each in frames[first : last + 1]])
        found += [numbers[first + place] for place in lost_frames(present)]
    return found


def _spans_at(numbers: Sequence[int], present: Sequence[bool]) -> list[tuple[int, int]]:
    """Intervals (first, last number) in which ``present`` is true. A gap of two frames ends an interval."""
    found: list[tuple[int, int]] = []
    for first, last in spans_of(present):
        begin = numbers[first]
        for before, number in zip(numbers[first:last], numbers[first + 1 : last + 1], strict=True):
            if number - before > 2:
                found.append((begin, before))
                begin = number
        found.append((begin, numbers[last]))
    return found
