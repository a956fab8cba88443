"""Shows a bag in the page: reads the messages of its topics frame by frame."""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from humansim_ros.data import messages
from humansim_ros.data.evaluation import EstimateStream, LiveOptions, PoseSequence, SequenceBuilder
from humansim_ros.data.messages import Frames, PoseFrame, Transforms, begins_with_stamp, readable_type
from humansim_ros.data.recorded import Place, RecordedMessages
from humansim_ros.errors import HumansimError, HumansimWarning
from humansim_ros.people.humans import Human
from humansim_ros.types import Indices
from humansim_ros.view.sources.picking import PIXEL_CHANNELS
from humansim_ros.view.sources.seen_topics import SeenTopics, seen_topics
from humansim_ros.view.sources.source import IMAGE_WIDTH, JOINTS, POSES, FrameRequest, PixelInfo, ViewFrame
from humansim_ros.view.sources.topic_frames import PERIOD, SAMPLES, TopicFrame, TopicFrames, TopicSource
from humansim_ros.view.sources.tracks import (
    MOST_MOTION,
    ErrorPlan,
    ErrorTrack,
    Tracker,
    TrackOutline,
    TrackSample,
    coarse_to_fine,
    has_message,
    lost_frames,
    seen_shares,
    spans_of,
)

#: Largest size of the cache of messages, bytes: for the page, and for the reader of the tracks.
_MAX_KEPT, _MAX_TRACKS = 256 << 20, 64 << 20
#: Most and fewest frames in which visibility is read for the timeline, and most values in all of them.
_MOST_VIEWS, _FEWEST_VIEWS, _MOST_VALUES = 600, 30, 20_000


class BagViewSource(TopicSource):
    """A bag that plays in the page. At the start, all its messages are read once to find the frames.

    Each stamp of the joints of people is a frame. If there are no people, each stamp of the topic with the
    most messages is a frame. ``messages`` tells the user what the bag lacks.

    Args:
        path: The bag.
        estimate: Topic of a tracker's estimate; ``*`` stands for any name of a person.
        options: How the estimate is read and compared.
        humans: Humans whose bodies the people may have, in addition to the built-in humans.
        image_width: Width to which wider images are scaled down, pixels.

    Raises:
        BagError: The bag cannot be read.
        HumansimError: The bag has no topic of the estimate.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        estimate: str | None = None,
        options: LiveOptions | None = None,
        humans: Sequence[Human] = (),
        image_width: int = IMAGE_WIDTH,
    ) -> None:
        self.path, self._options = Path(path), options or LiveOptions()
        super().__init__(TopicFrames(humans, options, image_width))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", HumansimWarning)
            self._messages = RecordedMessages(path, _MAX_KEPT)
        try:
            self._note_warnings(caught)
            types = {name: topic.type for name, topic in self._messages.topics.items()}
            self._topics = seen_topics(types, estimate, self._options.keypoints)
            if estimate is not None and not self._topics.estimate:
                raise HumansimError(
                    f"the bag has no topic {estimate} with poses, and there is no file of that name",
                    path=path,
                )
            #: Places of the messages.
            self._logs = self._survey()
            self._stamps = self._frame_stamps()
            self.start = int(self._stamps[0])
            self._last = 0
            self._shown.see(self._topics, self._messages.read(self._logs.first()))
            for name in self._shown.skinless:
                self._shown.add_skin(name, self._samples(name))
            self._note_missing()
        except BaseException:
            self._messages.close()
            raise

    def _note_warnings(self, caught: Iterable[warnings.WarningMessage]) -> None:
        for each in caught:
            if issubclass(each.category, HumansimWarning):
                self._shown.note(str(each.message))
            else:
                warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)

    def _note_missing(self) -> None:
        topics = self._topics
        if not topics.cameras:
            self._shown.note("The bag has no cameras: no topic is a camera_info.")
        elif not any(camera.images for camera in topics.cameras.values()):
            self._shown.note("The bag has no images.")
        if not topics.people:
            self._shown.note("The bag has no people: no topic is humans/<name>/joints.")

    # --- the source

    @property
    def title(self) -> str:
        return self.path.stem

    @property
    def period(self) -> int:
        steps = np.diff(self._stamps)
        return max(1, int(np.median(steps))) if len(steps) else PERIOD

    @property
    def frames(self) -> int:
        return len(self._stamps)

    def frame(self, index: int, wanted: FrameRequest = POSES) -> ViewFrame:
        self._last = min(max(index, 0), self.frames - 1)
        found = self._frame(self._last, wanted.cameras, wanted.channels)
        frame = self._shown.frame(found, wanted)
        if self.estimate is None:
            return frame
        people = self.estimate.at(found.stamp, self.period // 2)
        points, errors = self._shown.beside(people, found.data) if people else ({}, {})
        return replace(frame, estimate=points, estimate_errors=errors)

    def describe(self, camera: str, x: int, y: int) -> PixelInfo:
        return self._shown.describe(self._frame(self._last, [camera], PIXEL_CHANNELS), camera, x, y)

    def tracks(self) -> BagTracks | None:
        if self.frames < 2:
            return None
        topics, stamps, half = self._topics.light, self._stamps, self.period // 2
        logs, plan = self._logs, self._plan
        people = [of_person["joints"] for of_person in topics.people.values()]
        present = {topic: has_message(stamps, self._stamps_of(topic), half) for topic in people}
        wanted = set(topics.topics) - set(topics.estimate)
        compared = [] if plan is None else plan.frames.tolist()
        read = {*coarse_to_fine(self.frames, MOST_MOTION), *compared}
        read |= set(coarse_to_fine(self.frames, _most_views(topics)))
        estimate = list(self._topics.estimate)
        estimates: list[Mapping[str, Place]] = []
        if plan is not None and plan.estimate is None:
            estimates = [
                logs.near(stamp, estimate, 0, 0) if stamp >= 0 else {} for stamp in plan.own.tolist()
            ]
        first = logs.first()
        return BagTracks(
            path=self.path,
            topics=topics,
            stamps=stamps,
            period=self.period,
            spans={
                name: spans_of(present[of_person["joints"]].tolist())
                for name, of_person in topics.people.items()
            },
            drops={name: lost for name in topics.cameras if (lost := self._lost(name, half))},
            first={topic: first[topic] for topic in wanted if topic in first},
            places={index: logs.near(int(stamps[index]), wanted, half, 0) for index in sorted(read)},
            transforms=self._shown.transforms,
            options=self._options,
            plan=plan,
            estimates=estimates,
        )

    @cached_property
    def _plan(self) -> ErrorPlan | None:
        """Frames in which the estimate is compared with the truth; None if there is no estimate."""
        if self.estimate is not None:
            return ErrorPlan.of(self._stamps, self.estimate.poses, self.estimate.options)
        if not self._topics.estimate:
            return None
        own = self._logs.stamps(list(self._topics.estimate))
        return ErrorPlan.of(self._stamps, np.array(own, np.int64), self._options)

    def _lost(self, camera: str, half: int) -> list[int]:
        """Numbers of the frames in which an image of a camera (of any channel) was lost. ``half``: half a
        period, ns."""
        found: set[int] = set()
        for topic in self._topics.cameras[camera].images.values():
            found |= set(lost_frames(has_message(self._stamps, self._stamps_of(topic), half)))
        return sorted(found)

    def _stamps_of(self, topic: str) -> NDArray[np.int64]:
        return np.array(self._logs.stamps([topic]), np.int64)

    def close(self) -> None:
        self._messages.close()

    # --- messages

    def _survey(self) -> Frames[Place]:
        """Read the bag once, and return the places of the messages of all topics that can be shown."""
        found: Frames[Place] = Frames()
        lasting = self._topics.lasting
        stamped = {name: _has_stamp(self._topics.types[name]) for name in self._topics.topics}
        for name, place, content in self._messages.places(self._topics.topics):
            if name in self._topics.transforms:
                try:
                    self._shown.transforms.add(content, name)
                except HumansimError as error:
                    self._shown.note(f"{name}: {error.message}")
                continue
            stamp = place.log
            if stamped[name]:
                try:
                    stamp = messages.serialised_stamp(content[:12])
                except HumansimError as error:
                    self._shown.note(f"{name}: {error.message}")
                    continue
            (found.keep if name in lasting else found.add)(name, stamp, place)
        return found

    def _frame_stamps(self) -> Indices:
        """Stamps of the frames. There is at least one frame."""
        found = self._logs.stamps([topics["joints"] for topics in self._topics.people.values()])
        if not found:
            stamps = [self._logs.stamps([topic]) for topic in self._logs.first()]
            found = max(reversed(stamps), key=len, default=[])
        return np.array(found or [0], np.int64)

    def _frame(self, index: int, cameras: Collection[str], channels: Collection[str]) -> TopicFrame:
        """Read the messages of a frame, with the images of the given cameras and channels."""
        topics, stamp = self._topics, int(self._stamps[index])
        wanted = {"rgb" if channel == JOINTS else channel for channel in channels}
        left_out = topics.on_demand
        for name in cameras:
            if name in topics.cameras:
                camera = topics.cameras[name]
                left_out -= {topic for channel, topic in camera.images.items() if channel in wanted}
                left_out -= {camera.joints}
        shown = [topic for topic in topics.topics if topic not in left_out]
        logs = self._logs.near(stamp, shown, self.period // 2)
        return TopicFrame(index, stamp, int(self._stamps[0]), self._messages.read(logs))

    def _samples(self, name: str) -> list[tuple[bytes, bytes]]:
        """Serialised joints and vertices of a person in ``SAMPLES`` frames, to compute skinning weights."""
        topics = self._topics.people[name]
        pair = [topics["joints"], topics["vertices"]]
        common = sorted(set(self._logs.stamps(pair[:1])) & set(self._logs.stamps(pair[1:])))
        found = []
        places = np.unique(np.linspace(0, len(common) - 1, SAMPLES).astype(int)) if common else ()
        for place in places:
            data = self._messages.read(self._logs.near(common[place], pair, 0))
            if data.keys() == set(pair):
                found.append((data[pair[0]], data[pair[1]]))
        return found


def _has_stamp(kind: str) -> bool:
    try:
        return begins_with_stamp(readable_type(kind))
    except HumansimError:  # a type that is not installed and that rosbags does not know
        return False


# --- tracks


@dataclass(frozen=True)
class BagTracks:
    """Job that reads the tracks of a bag, in another process.

    Attributes:
        path: The bag.
        topics: Topics that are read, without images, meshes and vertices.
        stamps: (F,) int64 stamps of the frames, nanoseconds.
        period: Nanoseconds between frames.
        spans: First and last frame of each interval in which a person is there, by person.
        drops: Frames with a lost image, by camera. Cameras without lost images are absent.
        first: Places of the first messages by topic.
        places: Places of the messages of the frames that are read, by topic.
        transforms: Transforms of tf.
        options: How an estimate is compared.
        plan: Frames in which an estimate is compared with the truth; None if there is no estimate.
        estimates: Places of the messages of the estimate by topic, for each compared frame.
    """

    path: Path
    topics: SeenTopics
    stamps: NDArray[np.int64]
    period: int
    spans: Mapping[str, Sequence[tuple[int, int]]]
    drops: Mapping[str, Sequence[int]]
    first: Mapping[str, Place]
    places: Mapping[int, Mapping[str, Place]]
    transforms: Transforms
    options: LiveOptions
    plan: ErrorPlan | None = None
    estimates: Sequence[Mapping[str, Place]] = ()

    def start(self) -> Tracker:
        """Open the bag, in the process that reads the tracks."""
        return Tracker(_BagTracks(self))


class _BagTracks:
    def __init__(self, job: BagTracks) -> None:
        self._job = job
        self._shown = TopicFrames((), job.options)
        self._shown.transforms = job.transforms
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", HumansimWarning)  # the page has already shown the warnings
            self._messages = RecordedMessages(job.path, _MAX_TRACKS)
        self._shown.see(job.topics, self._read(job.first))

    def outline(self) -> TrackOutline:
        job, people, cameras = self._job, self._shown.people, self._job.topics.cameras
        return TrackOutline(
            frames=len(job.stamps),
            period=job.period,
            cameras=tuple(cameras),
            joints={name: human.skeleton.joint_names for name, human in people.items()},
            spans=job.spans,
            drops=job.drops,
            projected=[name for name, camera in cameras.items() if not camera.joints],
            has_views=bool(cameras and people),
            most_views=_most_views(job.topics),
            has_errors=job.plan is not None,
        )

    def motion(self, index: int) -> TrackSample:
        joints = self._shown.frame(self._frame(index)).joints
        return TrackSample({name: each[:, :3, 3].astype(np.float32) for name, each in joints.items()})

    def views(self, index: int) -> TrackSample:
        seen: dict[str, dict[str, tuple[float, float]]] = {}
        for person, camera, states in self._shown.visibility(self._frame(index)):
            seen.setdefault(person, {})[camera] = seen_shares(states)
        return TrackSample(seen=seen)

    def errors(self) -> ErrorTrack:
        plan = self._job.plan
        if plan is None or plan.problem:
            return ErrorTrack(note="" if plan is None else plan.problem)
        truth = SequenceBuilder(str(self._job.path))
        for index in plan.frames.tolist():
            stamp = int(self._job.stamps[index])
            truth.add_frame(stamp)
            for name, (names, positions) in self._shown.truth(self._frame(index).data).items():
                truth.add(stamp, name, tuple(names), positions)
        return plan.compare(truth.build(), plan.estimate or self._estimate(plan))

    def close(self) -> None:
        self._messages.close()

    def _estimate(self, plan: ErrorPlan) -> PoseSequence:
        """Read the estimate in the compared frames from its topics."""
        stream = EstimateStream("the estimate")
        for stamp, places in zip(plan.own.tolist(), self._job.estimates, strict=True):
            for topic, people in self._shown.estimated(self._read(places)):
                stream.add(PoseFrame(stamp, "", people), topic, stamp)
        return stream.sequence()

    def _frame(self, index: int) -> TopicFrame:
        job = self._job
        return TopicFrame(index, int(job.stamps[index]), int(job.stamps[0]), self._read(job.places[index]))

    def _read(self, places: Mapping[str, Place]) -> dict[str, bytes]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", HumansimWarning)
            return self._messages.read(places)


def _most_views(topics: SeenTopics) -> int:
    """Most frames in which visibility is read for the timeline: fewer with many people and cameras."""
    values = max(1, len(topics.people) * len(topics.cameras))
    return min(_MOST_VIEWS, max(_FEWEST_VIEWS, _MOST_VALUES // values))
