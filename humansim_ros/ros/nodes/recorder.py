"""Node ``recorder``: records topics of a live graph into a bag, serialised as they arrive.

The quality of service of each subscription is that of the publishers. Topics that appear later are recorded,
too. Messages wait in a queue with a limited number of bytes, and a thread writes them.

In real time, messages for which the queue has no space are dropped and counted. In lockstep nothing is
dropped: the node reports on ``frame_done`` that all messages of a frame are in the file, and the player waits
for it. A frame that the player sends again is recorded only once.

Parameter ``resume`` continues a bag, for example after the node was killed. It begins a new file in the
folder of the bag.
"""

from __future__ import annotations

import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, get_args

from rclpy.event_handler import QoSMessageLostInfo, SubscriptionEventCallbacks
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import TimeReference
from std_msgs.msg import Header

from humansim_ros.data.bags import (
    SQLITE_DEPRECATED,
    BagMessage,
    BagReader,
    BagThread,
    BagTopic,
    BagWriter,
    Compression,
    Storage,
    check_topics,
)
from humansim_ros.data.messages import (
    RecordedFrames,
    TimedTopics,
    Topic,
    begins_with_stamp,
    header,
    message_type,
    read_frame_number,
    scene_topics,
    serialised_stamp,
    to_nanoseconds,
)
from humansim_ros.errors import HumansimError, HumansimWarning, RosError, printable, some_of
from humansim_ros.render.interface import CHANNEL_TABLE
from humansim_ros.ros.graph.clock import ClockSteps
from humansim_ros.ros.graph.graph import TopicChoice, similar
from humansim_ros.ros.graph.guarded_node import ANY_SIZE
from humansim_ros.ros.graph.qos import DATA, DONE, FRAME_DONE, SCENE_TIME, recorded_qos, subscription_profile
from humansim_ros.ros.processes.node import SuiteNode, loaded_scene
from humansim_ros.scene.core import FaultSchedule, Scene

#: Most frames with a remembered number of copies, since late images come after images of newer frames.
_REMEMBERED = 1000
#: Most times that an image is sent because of simulated faults.
_MOST = 2


class ImageCopies:
    """Knows how many times the message of a topic and stamp is sent.

    Args:
        schedules: Faults by topic, for topics with messages that may be sent twice.
    """

    def __init__(self, schedules: Mapping[str, FaultSchedule]) -> None:
        self._schedules = schedules
        self._known: dict[str, dict[int, int]] = defaultdict(dict)

    def __bool__(self) -> bool:
        """Whether any topic may have messages that are sent twice."""
        return bool(self._schedules)

    def note(self, stamp: int, scene_time: int) -> None:
        """Note that a frame has begun. ``stamp``, ``scene_time``: nanoseconds."""
        for topic, schedule in self._schedules.items():
            faults, known = schedule.at_time(scene_time), self._known[topic]
            known[faults.stamp(stamp)] = len(faults.sent)
            if len(known) > _REMEMBERED:
                del known[next(iter(known))]

    def __call__(self, topic: str, stamp: int) -> int:
        """Number of times that the message with this topic and stamp is sent. Before :meth:`note` of its
        frame, the largest possible number."""
        if topic not in self._schedules:
            return 1
        return self._known[topic].get(stamp, _MOST)


#: Seconds between two searches for new topics and publishers.
_DISCOVERY_EVERY = 0.25
#: Most new subscriptions in one search. Each takes milliseconds during which no message is received.
_MAX_NEW = 20
#: Most topics, since the middleware needs 100 kB for each.
_MAX_TOPICS = 1000
#: Seconds after which topics without messages are reported.
_REPORT_AFTER = 5.0
#: A stopped recorder still reads arrived messages, but not longer than this, seconds.
_MAX_TAKING = 1.0
#: Most topics that a line of the log names.
_MAX_NAMED = 5
#: If a bag is continued, the messages of this time before its end, nanoseconds, may be sent again.
_REPEATED = 10_000_000_000


@dataclass
class _Recorded:
    """A recorded topic.

    Attributes:
        name: Name of the topic.
        kind: Message class.
        number: Number of the topic in the bag.
        stamped: Whether messages begin with a stamp.
        publishers: Number of publishers to which the profile was adapted.
        profile: Profile of the subscription.
        subscription: The subscription.
    """

    name: str
    kind: Any
    number: int
    stamped: bool
    publishers: int
    profile: QoSProfile | None = None
    subscription: Any = None


class RecorderNode(SuiteNode):
    """Records topics into a bag. ``scene``: scene that its parameter names, if loaded already."""

    def __init__(self, scene: Scene | None = None, **options: Any) -> None:
        super().__init__("recorder", **options)
        fixed = partial(self.described_parameter, read_only=True)
        texts = Parameter.Type.STRING_ARRAY
        path = self.text_parameter("scene", "", "Scene file whose topics are recorded; empty: none")
        description = "Topics: names or patterns such as /left/*; none: the topics of the scene, or all"
        names = fixed("topics", texts, description) or ()
        description = "Topics of other nodes with a message for each frame in lockstep; they are recorded"
        awaited = fixed("awaited", texts, description)
        lockstep = bool(fixed("lockstep", False, "The player waits for the recorder"))
        description = "Bytes of messages that wait for the disk; in real time others are dropped then"
        max_queue = int(fixed("max_queue", 1 << 28, description, (1, 2**40)))
        if path and scene is None:
            scene = loaded_scene(path)
        if awaited is None:
            members = scene.config.time.wait_for if path and scene and lockstep else ()
            awaited = [each.topic for each in members if each.topic]
        space = self.get_namespace()
        topics = scene_topics(scene) if path and scene else []
        if topics and not names:
            names = [*(topic.in_namespace(space) for topic in topics if topic.recorded), "/clock"]
        self._choice = TopicChoice.of([*names, *awaited], space)
        #: Types of the topics of the scene, by name.
        self._types = {topic.in_namespace(space): topic.type_name for topic in topics}
        self._frames: RecordedFrames | None = None
        self._timed: TimedTopics | None = None
        self._copies = ImageCopies({})
        if lockstep:
            per_frame = [topic.in_namespace(space) for topic in topics if has_message_per_frame(topic)]
            chosen = [topic for topic in (*per_frame, "/clock") if self._choice.has(topic)]
            if scene is not None:
                self._copies = _copies(scene, {topic.in_namespace(space): topic for topic in topics})
                self._timed = TimedTopics(scene, space)
            awaited = TopicChoice.of(awaited, space).patterns
            self._frames = RecordedFrames(chosen, awaited, self._copies)
        self._done = self.create_publisher(Header, FRAME_DONE, DONE) if lockstep else None
        self._clock_steps = ClockSteps(lambda: self.now(), self.has_simulated_time)
        #: Log time of the last message, and nanoseconds by which the clock has been set back.
        self._log_time = self._set_back = 0
        #: Number of messages in the bag or in the queue; and number of dropped messages.
        self.received = self._dropped = 0
        self._recorded: dict[str, _Recorded] = {}
        self._refused: dict[str, tuple[str, ...]] = {}
        self._started = self._waiting_since = time.monotonic()
        self._unmatched_reported = not self._choice.patterns
        on_written = self._report if lockstep else None
        self._bag = BagThread(self._bag_opener(), max_queue, on_written)
        if lockstep:
            # a second subscription, even if the topic is recorded
            self.create_subscription(TimeReference, SCENE_TIME, self._on_scene_time, DATA, raw=True)
        self.create_timer(_DISCOVERY_EVERY, self._discover, clock=self._steady_clock)

    def _bag_opener(self) -> Callable[[], BagWriter]:
        """Read the parameters of the bag. Returns the function that opens it."""
        fixed = partial(self.described_parameter, read_only=True)
        text = self.text_parameter("output", "", "Folder of the bag")
        storages, compressions = get_args(Storage), get_args(Compression)
        storage = self.choice_parameter("storage", storages[0], storages, "Format of the files")
        description = "Of mcap files"
        compression = self.choice_parameter("compression", compressions[0], compressions, description)
        description = "Bytes at which a new file of the bag begins; 0: never"
        max_size = int(fixed("max_bag_size", 0, description, (0, 1 << 62)))
        description = "Seconds after which a new file of the bag begins; 0: never"
        max_duration = self.number_parameter("max_bag_duration", 0.0, 0.0, 1e9, description)
        resume = bool(fixed("resume", False, "Continue the bag if it exists"))
        if not text:
            raise RosError("name the folder of the bag: --ros-args -p output:=FOLDER", key="parameter output")
        if storage == "sqlite3":
            self.get_logger().warn(SQLITE_DEPRECATED)
        output = self._output = Path(text).absolute()
        return lambda: self._opened(
            output,
            resume=resume and output.is_dir(),
            storage=storage,
            compression=compression,
            max_size=max_size,
            max_duration=max_duration,
        )

    def _opened(self, folder: Path, **options: Any) -> BagWriter:
        """Open a bag. In an existing one, note its last messages, since they will be repeated or
        continued."""
        writer = BagWriter(folder, **options)
        if writer.end is None:
            return writer
        self._log_time = writer.end
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", HumansimWarning)  # that the new file is not finished
            with BagReader(folder) as reader:
                for message in reader.messages(start=max(0, writer.end - _REPEATED)):
                    if self._frames is not None and message.published is not None:
                        topic = reader.topics[message.topic].name
                        self._frames.add(topic, message.published, bytes(message.data))
        return writer

    # --- topics

    def _discover(self) -> None:
        """Subscribe to chosen topics that have appeared, and react to changes of publishers."""
        if self._bag.error is not None:
            self.exit_code = 1
            return
        new: list[str] = []
        problems: list[str] = []
        for name, types in self.get_topic_names_and_types():
            if recorded := self._recorded.get(name):
                self._follow_publishers(recorded)
            elif len(new) + len(problems) < _MAX_NEW and self._is_new(name, tuple(types)):
                try:
                    self._record(name, types)
                    new.append(name)
                except HumansimError as error:
                    self._refused[name] = tuple(types)
                    problems.append(f"{printable(name, 100)} is not recorded: {error}")
        if new:
            self.get_logger().info(f"recording {_listed(new, ', ')}")
        if problems:
            self.get_logger().warn(_listed(problems, "; "))
        self._report_unmatched()
        self._report_missing()

    def _is_new(self, name: str, types: tuple[str, ...]) -> bool:
        """Whether a topic must be recorded now: it has publishers, and was not refused with these types."""
        is_chosen = self._choice.has(name) and self._refused.get(name) != types
        return is_chosen and self.publisher_count(name) > 0

    def publisher_count(self, topic: str) -> int:
        """Number of publishers of a topic, even if ROS does not permit its name."""
        return int(self.handle.get_count_publishers(topic))

    def _record(self, name: str, types: Sequence[str]) -> None:
        if len(self._recorded) >= _MAX_TOPICS:
            raise RosError(f"there are {_MAX_TOPICS} others already: choose topics")
        kind_name = self._types.get(name) or types[0]
        if kind_name not in types or (len(types) > 1 and name not in self._types):
            raise RosError(f"its publishers disagree about its type: {', '.join(map(printable, types))}")
        kind = message_type(kind_name)
        offers = [each.qos_profile for each in self.get_publishers_info_by_topic(name)]
        topic = BagTopic(name, kind_name, recorded_qos(offers))
        check_topics([topic])
        number = self._bag.add_topic(topic)
        recorded = _Recorded(name, kind, number, begins_with_stamp(kind), len(offers))
        self._subscribe(recorded, subscription_profile(offers))
        self._recorded[name] = recorded

    def _subscribe(self, recorded: _Recorded, profile: QoSProfile) -> None:
        """Subscribe to a topic with a profile. An earlier subscription is replaced."""
        old = recorded.subscription
        recorded.subscription = self.create_subscription(
            recorded.kind,
            recorded.name,
            partial(self._on_message, recorded),
            profile,
            raw=True,
            max_bytes=ANY_SIZE,
            event_callbacks=SubscriptionEventCallbacks(message_lost=partial(self._on_lost, recorded.name)),
        )
        recorded.profile = profile
        if old is not None:
            self.destroy_subscription(old)

    def _follow_publishers(self, recorded: _Recorded) -> None:
        """Change the profile of a subscription if new publishers offer less quality of service."""
        number = self.publisher_count(recorded.name)
        if number in (0, recorded.publishers):
            return
        recorded.publishers = number
        offers = [each.qos_profile for each in self.get_publishers_info_by_topic(recorded.name)]
        profile = subscription_profile(offers)
        if profile != recorded.profile:
            self._subscribe(recorded, profile)

    def _report_unmatched(self) -> None:
        """Report once the names and patterns that match no topic."""
        if self._unmatched_reported or time.monotonic() < self._started + _REPORT_AFTER:
            return
        self._unmatched_reported = True
        known = sorted({name for name, _ in self.get_topic_names_and_types()} | set(self._types))
        for pattern in self._choice.unmatched([*self._recorded, *self._refused, *self._types]):
            advice = similar(pattern, known)
            self.get_logger().warn(f"nothing publishes {pattern}: it is recorded when it appears{advice}")

    def _report_missing(self) -> None:
        """Report, every five seconds, the topics that a frame in lockstep waits for."""
        now = time.monotonic()
        if self._frames is None or not self._frames.missing:
            self._waiting_since = now
        elif now > self._waiting_since + _REPORT_AFTER:
            self._waiting_since = now
            self.get_logger().warn(f"the frame has no message yet of {_listed(self._frames.missing, ', ')}")

    # --- messages

    def _on_message(self, recorded: _Recorded, data: bytes) -> None:
        stamp = _stamp(data) if recorded.stamped else None
        frames = self._frames
        if frames is None:
            self._log_time = max(self._log_time, self._time())
        elif stamp is None or frames.add(recorded.name, stamp, data):
            self._log_time = max(self._log_time, frames.newest)
        else:
            self.count("repeated")
            self._end_frame()
            return
        message = BagMessage(recorded.number, self._log_time, data, stamp)
        if self._bag.add(message, wait=frames is not None):
            self.received += 1
            self.count("messages")
            self.count("bytes", len(data))
        elif self._bag.error is None:
            self._drop(1, "the disk is too slow")
        self._end_frame()

    def _time(self) -> int:
        """Log time for messages, nanoseconds. Unlike the clock, this time is never set back."""
        now, step = self._clock_steps.read()
        if step < 0:
            self._set_back -= step
            self.get_logger().warn(
                f"the clock was set {-step * 1e-9:.3f} s back: the times of the bag go on, and stamps are as "
                "published"
            )
        return now + self._set_back

    def _on_lost(self, name: str, lost: QoSMessageLostInfo) -> None:
        self._drop(lost.total_count_change, f"the recorder was too slow for {name}")

    def _drop(self, number: int, reason: str) -> None:
        """Count messages that are not recorded."""
        self.count("drops", number)
        self._dropped += number
        text = f"{reason}: {self._dropped} messages were not recorded until now"
        self.get_logger().warn(text, throttle_duration_sec=5.0)

    # --- lockstep

    def _on_scene_time(self, data: bytes) -> None:
        """Handle the start of a frame. It may be sent again, if the player has missed the report."""
        stamp = serialised_stamp(data)
        if self._frames is None:
            return
        resting: Collection[str] = ()
        if self._copies or self._timed:
            message = deserialize_message(data, TimeReference)
            self._copies.note(stamp, to_nanoseconds(message.time_ref))
            if self._timed:
                resting = self._timed.resting(self._frames.awaited, read_frame_number(message))
        self._frames.begin(stamp, resting)
        if self._frames.is_finished(stamp):
            self._report(stamp)
        self._end_frame()

    def _end_frame(self) -> None:
        """If all messages of the frame have arrived, have them written, and then report the frame."""
        stamp = self._frames.take_whole() if self._frames else None
        if stamp is not None:
            self._bag.end_frame(stamp)

    def _report(self, stamp: int) -> None:
        """Tell the player that a frame is in the file."""
        with self.guard("report of a frame", "the player will repeat it"):
            if self._done is not None:
                self._done.publish(header(stamp, self.get_name()))
                self.count("frames")

    # --- end

    def complete(self) -> None:
        """Write all received messages, and finish the bag."""
        deadline = time.monotonic() + _MAX_TAKING
        for recorded in self._recorded.values():
            self.take_waiting(recorded.subscription, deadline)
            self.destroy_subscription(recorded.subscription)
        self._bag.close()
        if self._bag.error is not None:
            raise self._bag.error
        dropped = f"; {self._dropped} more were dropped" if self._dropped else ""
        self.get_logger().info(
            f"{self._output}: {self._bag.written} messages of {len(self._recorded)} topics, "
            f"{self._bag.written_bytes / 1e6:.1f} MB{dropped}"
        )

    def close(self) -> None:
        """Finish the bag."""
        self._bag.close()


def has_message_per_frame(topic: Topic[Any]) -> bool:
    """Whether a topic has exactly one message for each frame, soon after the frame.

    This is false for topics that compare a frame with the next or previous frame, which a restarted camera
    lacks; topics without a stamp; topics that a camera with faults may lose; sweeps of scanners; and people
    who may be out of sight.
    """
    compared = any(CHANNEL_TABLE[channel].adjacent_frame for channel in topic.channels)
    of_frames = topic.per_frame and not (topic.scanner or topic.faulty or topic.sparse)
    return of_frames and not compared and begins_with_stamp(topic.type)


def _copies(scene: Scene, topics: Mapping[str, Topic[Any]]) -> ImageCopies:
    """Make the object that knows how many times messages are sent. ``topics``: topics by absolute name."""
    schedules = {}
    for name, topic in topics.items():
        faults = scene.scene_cameras[topic.camera].faults if topic.faulty else None
        if faults is not None and faults.config.duplicate is not None:
            schedules[name] = faults
    return ImageCopies(schedules)


def _listed(texts: Sequence[str], separator: str) -> str:
    return some_of(texts, _MAX_NAMED, separator, f"{separator}and {{}} more topics")


def _stamp(data: bytes) -> int | None:
    """Stamp at the start of a message; None for an invalid stamp."""
    try:
        return serialised_stamp(data)
    except RosError:
        return None
