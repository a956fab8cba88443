"""Shows a running ROS graph in the page: the topics of this package and of other programs."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.context import Context
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

from humansim_ros.data import messages
from humansim_ros.data.evaluation import LiveOptions, topic_pattern
from humansim_ros.data.messages import (
    TF,
    Frames,
    begins_with_stamp,
    check_serialised,
    deserialised,
    message_type,
    read_people,
)
from humansim_ros.errors import HumansimError, RosError, printable
from humansim_ros.people.humans import Human
from humansim_ros.ros.graph import ANY_SIZE, GuardedNode, absolute, subscription_profile
from humansim_ros.ros.processes import make_executor, spin
from humansim_ros.view.sources.picking import PIXEL_CHANNELS
from humansim_ros.view.sources.seen_topics import COMPRESSED_IMAGE, IMAGE, TF_TOPICS, SeenTopics, seen_topics
from humansim_ros.view.sources.source import IMAGE_WIDTH, JOINTS, POSES, FrameRequest, PixelInfo, ViewFrame
from humansim_ros.view.sources.topic_frames import PERIOD, SAMPLES, TopicFrame, TopicFrames, TopicSource
from humansim_ros.view.sources.tracks import (
    ArrivedFrame,
    LiveTracks,
    Tracks,
    TrackSample,
    has_message,
    seen_shares,
)

#: Seconds between two checks for wanted topics, and between two checks for topics of the graph.
_LOOK_EVERY, _DISCOVER_EVERY = 0.05, 0.5
#: A topic of images is unsubscribed when the page has not used it for this number of seconds.
_UNWANTED = 3.0
#: Longest wait until all messages of a frame have arrived, nanoseconds: without, and with an estimate.
_PATIENCE, _ESTIMATE_PATIENCE = 200_000_000, 1_500_000_000
#: Longest wait, seconds, for images that must be subscribed first to tell the values of a pixel.
_PIXEL_PATIENCE = 1.5
#: People and cameras without a publisher for this number of seconds are removed.
_LEFT_AFTER = 5.0
#: Seconds without a frame after which the page says so.
_SILENT = 3.0
#: Shortest time between two frames from which skinning weights are computed, nanoseconds.
_SAMPLE_EVERY = 300_000_000
#: Queue depth of subscriptions: of images, and of other topics.
_IMAGE_DEPTH, _DEPTH = 2, 100
#: Longest messages that are accepted, by type, bytes; then the limit of all other types.
_MAX_BYTES = {
    IMAGE: 256 << 20,
    COMPRESSED_IMAGE: 64 << 20,
    "sensor_msgs/msg/PointCloud2": 64 << 20,
    "shape_msgs/msg/Mesh": 32 << 20,
    TF: 1 << 20,
}
_MAX_OTHER = 256 << 10
#: Largest size of all stored messages, bytes; most stored messages of a topic; a new run begins when stamps
#: go back by more than this, nanoseconds.
_MAX_KEPT, _MAX_MESSAGES, _NEW_RUN = 512 << 20, 90, 10**9
#: Most stamps for which the time of arrival is stored.
_MAX_ARRIVALS = 4 * _MAX_MESSAGES
#: Most topics whose problems the user is told.
_MAX_PROBLEMS = 5
_MARKERS = "visualization_msgs/msg/MarkerArray"
#: Most messages of tf that are queued for the thread of the page.
_MAX_TRANSFORMS = 2000


class RosViewSource(TopicSource):
    """A ROS graph that is shown while it runs.

    A thread receives the messages; the thread of the page reads them without waiting. All messages of a frame
    have the same stamp. Images are received only while they are shown, since cameras of this package do not
    render images without a subscriber.

    Args:
        estimate: Topic of a tracker's estimate; ``*`` stands for the name of a person.
        options: How the estimate is read and compared.
        humans: Humans whose bodies the people may have, in addition to the built-in humans.
        namespace: Show only topics below this namespace, tf, and the estimate.
        image_width: Width to which wider images are scaled down, pixels.
        patience: Longest wait for the first people and cameras, seconds.

    Raises:
        RosError: A name is no valid topic or namespace.
    """

    def __init__(
        self,
        estimate: str | None = None,
        options: LiveOptions | None = None,
        humans: Sequence[Human] = (),
        namespace: str = "",
        image_width: int = IMAGE_WIDTH,
        patience: float = 5.0,
    ) -> None:
        super().__init__(TopicFrames(humans, options, image_width))
        self._reading = options or LiveOptions()
        self._receiver = _Receiver(_checked(estimate, namespace), namespace, self._reading)
        self._seen_of: tuple[SeenTopics, int] | None = None
        self._number = -1
        self._first: int | None = None
        #: The frame that was returned last: its messages, the request, and the frame itself.
        self._last: tuple[TopicFrame, Any, ViewFrame] | None = None
        #: Stamp of the frame for which :meth:`describe` was called. It is shown while the page is paused.
        self._pinned: int | None = None
        self._live = LiveTracks()
        #: Serialised joints and vertices, by person and stamp, to compute skinning weights.
        self._samples: dict[str, dict[int, tuple[bytes, bytes]]] = {}
        try:
            self._wait_for_first(patience)
        except BaseException:
            self.close()
            raise

    def _wait_for_first(self, patience: float) -> None:
        """Wait at most ``patience`` seconds for people or cameras, until no new ones appear for a moment."""
        end, quiet, known = time.monotonic() + patience, time.monotonic(), 0
        while time.monotonic() < end:
            self._see()
            now = len(self._shown.people) + len(self._shown.cameras)
            if now != known:
                quiet, known = time.monotonic(), now
            if known and time.monotonic() - quiet > 2 * _DISCOVER_EVERY:
                return
            time.sleep(_LOOK_EVERY)

    # --- the source

    @property
    def title(self) -> str:
        return f"ROS domain {self._receiver.domain}"

    @property
    def period(self) -> int:
        steps = np.diff(self._receiver.store.stamps(self._clock()))
        return max(1, int(np.median(steps))) if len(steps) else PERIOD

    @property
    def frames(self) -> None:
        return None

    @property
    def messages(self) -> Sequence[str]:
        return [*self._state(), *self._shown.messages]

    @property
    def timing(self) -> str:
        """Text with the age of the frame that is shown, images per second, and lost images by camera.

        The age is the time since the first message of the frame arrived. An image is lost if images with
        stamps before and after it have arrived.
        """
        if self._last is None:
            return ""
        now, arrivals = time.monotonic(), self._receiver.arrivals.copy()
        arrived = arrivals.get(self._last[0].stamp)
        found = [] if arrived is None else [f"{now - arrived:.2f} s old"]
        clock = self._receiver.store.stamps(self._clock())
        for name, camera in self._topics.cameras.items():
            received = [self._receiver.store.stamps([topic]) for topic in camera.images.values()]
            received = [stamps for stamps in received if len(stamps) > 1]
            times = [arrivals[stamp] for stamp in max(received, key=len, default=[]) if stamp in arrivals]
            if len(times) < 2:
                continue
            rate = (len(times) - 1) / max(times[-1] - times[0], 1e-3)
            lost = of = 0
            for stamps in received:
                expected = sum(stamps[0] <= stamp <= stamps[-1] for stamp in clock)
                lost, of = max((lost, of), (expected - len(stamps), expected))
            found.append(f"{name} {rate:.1f} Hz" + f", {lost} of {of} lost" * bool(lost))
        return "; ".join(found)

    def _state(self) -> Iterator[str]:
        """Yield messages for the user about what the graph lacks at present."""
        topics, store = self._topics, self._receiver.store
        if not topics.cameras and not topics.people:
            domain = self._receiver.domain
            yield f"Nothing in ROS domain {domain} can be shown yet: start humansim run, or cameras."
        elif not topics.people:
            yield "The graph has no people: no topic is humans/<name>/joints."
        elif not topics.cameras:
            yield "The graph has no cameras: no topic is a camera_info."
        if self._receiver.estimate is not None:
            silence = store.silence(list(topics.estimate), time.monotonic())
            if not topics.estimate:
                yield f"Nothing publishes the estimate, {self._receiver.estimate}."
            elif silence is None or silence > _SILENT:
                yield f"No estimate arrives on {self._receiver.estimate}."
        silence = store.silence(self._clock(), time.monotonic())
        if silence is not None and silence > _SILENT:
            yield f"No frame has arrived for {silence:.0f} s."
        yield from self._receiver.problems

    def frame(self, index: int, wanted: FrameRequest = POSES) -> ViewFrame:
        self._see()
        images = self._images(wanted.cameras, wanted.channels)
        self._receiver.want(images)
        if not wanted.wait:
            self._pinned = None
        found = self._frame(images, self._pinned)
        if found is None:
            return ViewFrame(index=0, stamp=0, scene_time=0, cameras=dict(self._shown.cameras))
        asked = tuple(wanted.cameras), tuple(wanted.channels), frozenset(wanted.full)
        if self._last is not None and self._last[1] == asked and _is_same(self._last[0], found):
            return self._last[2]
        frame = self._shown.frame(found, wanted)
        self._last = found, asked, frame
        return frame

    def describe(self, camera: str, x: int, y: int) -> PixelInfo:
        """Values of a pixel of the frame that was returned last, as topics have them.

        If images must be subscribed first, a newer frame that has them is used. Then :meth:`frame` returns
        that newer frame as long as it is called with ``wait``.

        Raises:
            RosError: There is no such camera, or the pixel is not in the image.
        """
        images = self._images([camera], PIXEL_CHANNELS, joints=True)
        self._receiver.want(images)
        end = time.monotonic() + _PIXEL_PATIENCE
        shown = None if self._last is None else self._last[0].stamp
        found = self._frame(images, shown)
        while (found is None or not set(images) <= found.data.keys()) and time.monotonic() < end:
            time.sleep(_LOOK_EVERY)
            self._see()
            found = self._frame(images)
        if found is None:
            raise RosError("no frame has arrived yet")
        self._pinned = found.stamp
        return self._shown.describe(found, camera, x, y)

    def live_tracks(self) -> Tracks | None:
        store, topics = self._receiver.store, self._topics
        clock = self._clock()
        pictures = {name: self._received(camera.images.values()) for name, camera in topics.cameras.items()}
        joints = {name: camera.joints for name, camera in topics.cameras.items()}
        received = self._received(joints.values())
        projected = [name for name, topic in joints.items() if topic not in received]
        last = self._newest_whole(
            clock, [*received, *(topic for each in pictures.values() for topic in each)]
        )
        if last is None:
            return None
        known = self._live.newest if last >= self._live.newest else -1
        new = np.array([stamp for stamp in store.stamps(clock) if known < stamp <= last], np.int64)
        half = self.period // 2

        def arrived(topic: str) -> NDArray[np.bool_]:
            return has_message(new, np.array(store.stamps([topic]), np.int64), half)

        people = {name: arrived(of_person["joints"]) for name, of_person in topics.people.items()}
        images = {
            name: np.all([arrived(topic) for topic in each], axis=0)
            for name, each in pictures.items()
            if each
        }
        for place, stamp in enumerate(new.tolist()):
            wanted = self._live.wants_sample(stamp)
            sample, errors = self._sample(stamp, received, projected) if wanted else (None, {})
            self._live.add(
                ArrivedFrame(
                    stamp,
                    frozenset(name for name, there in people.items() if there[place]),
                    {name: bool(there[place]) for name, there in images.items()},
                    sample,
                    projected,
                    errors,
                )
            )
        return self._live.tracks(
            self.period,
            {name: human.skeleton.joint_names for name, human in self._shown.people.items()},
            list(topics.cameras),
            projected,
            bool(topics.estimate),
        )

    def _received(self, wanted: Iterable[str]) -> list[str]:
        """Select the topics from which messages have arrived."""
        return [topic for topic in wanted if topic and self._receiver.store.stamps([topic])]

    def _sample(
        self, stamp: int, received: Collection[str], projected: Collection[str]
    ) -> tuple[TrackSample, Mapping[str, float]]:
        """Joints and visibility in a frame, and errors of the estimate by person.

        Args:
            stamp: Stamp of the frame.
            received: Received topics with the 2D joints of an image.
            projected: Cameras without such a topic. The joints are projected into them.
        """
        found = self._messages(stamp, received)
        frame = self._shown.frame(found)
        seen: dict[str, dict[str, tuple[float, float]]] = {}
        for person, camera, states in self._shown.visibility(found, projected):
            seen.setdefault(person, {})[camera] = seen_shares(states)
        positions = {name: each[:, :3, 3].astype(np.float32) for name, each in frame.joints.items()}
        return TrackSample(positions, seen), frame.estimate_errors

    def close(self) -> None:
        self._receiver.close()

    # --- frames

    def _see(self) -> None:
        """Take over new transforms, topics, people, cameras and objects from the receiver."""
        receiver = self._receiver
        receiver.move_transforms(self._shown)
        topics, changes = receiver.topics, receiver.changes
        if self._seen_of != (topics, changes) or self._shown.is_lacking:
            self._seen_of = topics, changes
            self._topics = topics
            self._shown.see(topics, receiver.store.newest())
        for name in self._shown.skinless:
            self._take_sample(name)

    def _take_sample(self, name: str) -> None:
        """Store joints and vertices of a person; once there are enough, compute the skinning weights."""
        store, topics = self._receiver.store, self._topics.people[name]
        pair = [topics["joints"], topics["vertices"]]
        self._receiver.want(pair[1:])
        samples = self._samples.setdefault(name, {})
        common = set(store.stamps(pair[:1])) & set(store.stamps(pair[1:]))
        stamp = max(common, default=None)
        if stamp is None or any(abs(stamp - other) < _SAMPLE_EVERY for other in samples):
            return
        data = store.near(stamp, pair, 0)
        if data.keys() == set(pair):
            samples[stamp] = data[pair[0]], data[pair[1]]
        if len(samples) >= SAMPLES:
            self._shown.add_skin(name, list(self._samples.pop(name).values()))

    def _images(self, cameras: Collection[str], channels: Collection[str], joints: bool = False) -> list[str]:
        """Topics of images of cameras and channels; and of the joints in them, if drawn or if ``joints``."""
        found = []
        own = {"rgb" if channel == JOINTS else channel for channel in channels}
        for name in cameras:
            camera = self._topics.cameras.get(name)
            if camera is not None:
                found += [topic for channel, topic in camera.images.items() if channel in own]
                if camera.joints and (joints or JOINTS in channels):
                    found.append(camera.joints)
        return found

    def _clock(self) -> list[str]:
        """Topics whose stamps define the frames: joints of people, else images, calibrations, estimates."""
        store, topics = self._receiver.store, self._topics
        people = [of_person["joints"] for of_person in topics.people.values()]
        images = [topic for camera in topics.cameras.values() for topic in camera.images.values()]
        infos = [camera.info for camera in topics.cameras.values()]
        choices = (people, images, infos, list(topics.estimate))
        return next((choice for choice in choices if store.stamps(choice)), [])

    def _frame(self, images: Collection[str], stamp: int | None = None) -> TopicFrame | None:
        """Messages of the frame at ``stamp`` (None: the newest complete frame); None if there is no frame."""
        if stamp is None:
            stamp = self._newest_whole(self._clock(), images)
        if stamp is None:
            return None
        if self._first is None or stamp < self._first:
            self._first = stamp
        if self._last is None or self._last[0].stamp != stamp:
            self._number += 1
        return self._messages(stamp, images)

    def _newest_whole(self, clock: Collection[str], images: Collection[str]) -> int | None:
        """Stamp of the newest complete frame, or of one that waited too long; None if there is no frame."""
        topics = self._topics
        people = [of_person["joints"] for of_person in topics.people.values()]
        patience = _ESTIMATE_PATIENCE if topics.estimate else _PATIENCE
        needed = [*people, *images, *topics.estimate]
        return self._receiver.store.newest_whole(clock, needed, patience, time.monotonic())

    def _messages(self, stamp: int, images: Collection[str]) -> TopicFrame:
        """Messages of the frame at a stamp, including those of ``images``, which are received on demand."""
        topics = self._topics
        wanted = set(topics.topics) - topics.on_demand | {*images, *topics.lasting}
        data = self._receiver.store.near(stamp, wanted, self.period // 2)
        return TopicFrame(max(self._number, 0), stamp, self._first or 0, data)


class _Receiver:
    """Receives the messages for a source: ROS node, thread and subscriptions.

    Args:
        estimate: Absolute topic of the estimate; None if there is no estimate.
        namespace: Namespace of the topics that are shown.
        reading: How an estimate is read.

    Attributes:
        store: Messages that have arrived.
        topics: Topics of the graph that can be shown.
        changes: Counter that increases when there may be new people, cameras or objects.
        arrivals: Time (monotonic clock) at which the first message arrived, by stamp, of the newest frames.
    """

    def __init__(self, estimate: str | None, namespace: str, reading: LiveOptions) -> None:
        self.estimate, self._reading = estimate, reading
        self._below = f"/{namespace.strip('/')}/" if namespace.strip("/") else "/"
        self._pattern = topic_pattern(estimate) if estimate is not None else None
        self.store: Frames[bytes] = Frames(
            max_of_topic=_MAX_MESSAGES, max_size=_MAX_KEPT, size_of=len, new_run=_NEW_RUN
        )
        self.topics = SeenTopics()
        self.changes = 0
        self.arrivals: dict[int, float] = {}
        self._problems: dict[str, str] = {}
        self._first_of: set[str] = set()
        #: Queue of tf messages with their topics.
        self._transforms: deque[tuple[bytes, str]] = deque(maxlen=_MAX_TRANSFORMS)
        #: Time (monotonic clock) at which the page last used each topic of images.
        self._wanted: dict[str, float] = {}
        #: Type, QoS profile and subscription, by topic.
        self._subscriptions: dict[str, tuple[str, QoSProfile, Any]] = {}
        self._offers: dict[str, list[tuple[str, QoSProfile]]] = {}
        #: Time (monotonic clock) since which a topic has had no publisher, by topic.
        self._left: dict[str, float] = {}
        self._lasting: set[str] = set()
        self._discover_at = 0.0
        self._stopped = threading.Event()
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = GuardedNode(
            f"_humansim_view_{os.getpid()}",
            context=self._context,
            start_parameter_services=False,
            enable_rosout=False,
        )
        self.domain = int(self._context.get_domain_id())
        self._node.create_timer(_LOOK_EVERY, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._thread = threading.Thread(target=self._run, name="humansim view ROS", daemon=True)
        self._thread.start()

    # --- for the thread of the page

    def want(self, images: Collection[str]) -> None:
        """Subscribe to topics of images, or keep them subscribed, for the next seconds."""
        now = time.monotonic()
        self._wanted |= dict.fromkeys(images, now)

    def move_transforms(self, shown: TopicFrames) -> None:
        """Move all queued tf messages into ``shown``."""
        while self._transforms:
            try:
                shown.transforms.add(*self._transforms.popleft())
            except HumansimError as error:
                shown.note(f"tf: {error.message}")

    def close(self) -> None:
        """Stop the thread, and destroy the node."""
        self._stopped.set()
        self._thread.join(10)

    # --- the thread

    def _run(self) -> None:
        executor = make_executor(self._context)
        executor.add_node(self._node)
        try:
            spin(self._node, executor, self._stopped.is_set, self._context)
        except RosError as error:
            self._problems = {"": f"Nothing is received any more: {error.message}"}
        finally:
            executor.remove_node(self._node)
            executor.shutdown()
            self._node.destroy_node()
            rclpy.try_shutdown(context=self._context)

    def _look(self) -> None:
        """Find topics of the graph; subscribe to the wanted topics, and unsubscribe the others."""
        now = time.monotonic()
        if now >= self._discover_at:
            self._discover_at = now + _DISCOVER_EVERY
            self._discover()
        pictures = self.topics.on_demand
        wanted = {topic for topic, last in self._wanted.copy().items() if now - last < _UNWANTED}
        for topic in self.topics.topics:
            if topic not in pictures or topic in wanted:
                self._follow(topic)
        for topic in list(self._subscriptions):
            if topic in pictures - wanted or topic not in self.topics.types:
                self._node.destroy_subscription(self._subscriptions.pop(topic)[2])
                self._wanted.pop(topic, None)
                self.store.forget(topic)

    def _discover(self) -> None:
        types = {
            name: kinds[0]
            for name, kinds in self._node.get_topic_names_and_types()
            if self._is_shown(name) and not self._has_left(name)
        }
        if types != self.topics.types:
            self.topics = seen_topics(types, self.estimate, self._reading.keypoints)
            self._lasting = self.topics.lasting
        self._offers = {
            topic: [
                (each.topic_type, each.qos_profile) for each in self._node.get_publishers_info_by_topic(topic)
            ]
            for topic in self.topics.topics
        }

    def _has_left(self, topic: str) -> bool:
        """Whether a subscribed topic has had no publisher for ``_LEFT_AFTER`` seconds."""
        if topic not in self._subscriptions or self._node.count_publishers(topic):
            self._left.pop(topic, None)
            return False
        return time.monotonic() - self._left.setdefault(topic, time.monotonic()) > _LEFT_AFTER

    def _is_shown(self, topic: str) -> bool:
        if topic.startswith(self._below) or topic in TF_TOPICS:
            return True
        return self._pattern is not None and self._pattern.fullmatch(topic) is not None

    def _follow(self, topic: str) -> None:
        """Subscribe to a topic. If the QoS or type of its publishers has changed, subscribe again."""
        kind = self.topics.types[topic]
        offers = [offer for each, offer in self._offers.get(topic, ()) if each == kind]
        if not offers:
            return
        profile = subscription_profile(offers)
        profile.depth = _IMAGE_DEPTH if kind in (IMAGE, COMPRESSED_IMAGE) else _DEPTH
        before = self._subscriptions.get(topic)
        if before is not None and before[:2] == (kind, profile):
            return
        try:
            found = message_type(kind)
        except RosError as error:
            self._note(topic, error)
            return
        stamped = begins_with_stamp(found)
        new = self._node.create_subscription(
            found,
            topic,
            partial(self._on_message, topic, kind, found, stamped),
            profile,
            raw=True,
            max_bytes=ANY_SIZE,
        )
        if before is not None:
            self._node.destroy_subscription(before[2])
        self._subscriptions[topic] = kind, profile, new

    def _note(self, topic: str, error: HumansimError) -> None:
        """Tell the user about the first error of a topic."""
        self._problems.setdefault(topic, f"{printable(topic, 100)}: {error.message}")

    @property
    def problems(self) -> Sequence[str]:
        """Messages for the user about topics that could not be received."""
        return list(self._problems.values())[:_MAX_PROBLEMS]

    def _on_message(self, topic: str, kind: str, found: Any, stamped: bool, data: bytes) -> None:
        try:
            self._take(topic, kind, found, stamped, data)
        except HumansimError as error:
            self._note(topic, error)

    def _take(self, topic: str, kind: str, found: Any, stamped: bool, data: bytes) -> None:
        """Store a message. Raises HumansimError if it is too long, or its stamp cannot be read."""
        limit = _MAX_BYTES.get(kind, _MAX_OTHER)
        check_serialised(data, found, limit)
        if kind == TF:
            self._transforms.append((data, topic))
            self._note_first(topic)
            return
        stamp = messages.serialised_stamp(data) if stamped else None
        if kind == _MARKERS:  # the stamp is in the markers
            stamp = read_people(kind, deserialised(data, found, limit), self._reading.names).stamp
            if stamp is None:
                return
        if topic not in self.topics.types:
            return
        if stamp is None or topic in self._lasting:
            self.store.keep(topic, stamp, data, time.monotonic())
        else:
            self.store.add(topic, stamp, data, time.monotonic())
            self.arrivals.setdefault(stamp, time.monotonic())
            while len(self.arrivals) > _MAX_ARRIVALS:
                del self.arrivals[next(iter(self.arrivals))]
        self._note_first(topic, again=not stamped)

    def _note_first(self, topic: str, again: bool = False) -> None:
        """Count a change if this is the first message of a topic, or if ``again``."""
        if again or topic not in self._first_of:
            self._first_of.add(topic)
            self.changes += 1


def _checked(estimate: str | None, namespace: str) -> str | None:
    """Absolute topic of an estimate. Raises RosError if the topic or the namespace is not valid."""
    for name in (estimate, namespace):
        if name is not None and any(letter.isspace() for letter in name):
            raise RosError(f"'{printable(name, 80)}' is no name of a topic or namespace")
    if estimate is None:
        return None
    if not estimate.strip("/"):
        raise RosError(f"'{printable(estimate, 80)}' is no topic: give a name such as /tracker/poses")
    return absolute(estimate, f"/{namespace.strip('/')}")


def _is_same(one: TopicFrame, other: TopicFrame) -> bool:
    """Whether two frames have the same stamp and the same messages."""
    return (
        one.stamp == other.stamp
        and one.data.keys() == other.data.keys()
        and all(one.data[topic] is content for topic, content in other.data.items())
    )
