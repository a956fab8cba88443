"""``humansim play``: publish the messages of a bag again, at the pace of the recording."""

from __future__ import annotations

import os
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.qos import QoSDurabilityPolicy
from rosgraph_msgs.msg import Clock

from humansim_ros.data.bags import BagMessage, BagReader, BagTopic
from humansim_ros.data.messages import message_type, to_time
from humansim_ros.errors import HumansimWarning, RosError, some_of
from humansim_ros.ros.graph.clock import ClockOwner
from humansim_ros.ros.graph.graph import TopicChoice, similar
from humansim_ros.ros.graph.guarded_node import GuardedNode
from humansim_ros.ros.graph.qos import publisher_profile
from humansim_ros.ros.processes.lockstep_settings import CLOCK_SEARCH
from humansim_ros.ros.processes.run_options import PlayOptions
from humansim_ros.ros.processes.runtime import make_executor

CLOCK_TOPIC = "/clock"
#: The first message is sent when no subscription has been added for the first time, and at the latest after
#: the second time, seconds.
_QUIET, _MAX_QUIET = 1.0, 4.0
#: Longest wait for subscribers to confirm messages, seconds. Fast DDS asks for this every three seconds.
_DELIVERY = 10.0
#: Most messages of a topic, and most bytes, that are sent at once without confirmation. The shared memory of
#: Fast DDS has 512 slots.
_MAX_AT_ONCE, _MAX_UNCONFIRMED = 400, 1 << 25
#: Wait at the end for the last messages to subscribers that do not confirm messages, seconds.
_LINGER = 0.2
#: Longest sleep, seconds, so that the process soon notices a key press.
_STEP = 0.02
#: Messages that are later than the first time (seconds) are sent without a pause. If they are later than the
#: second time, a warning is printed.
_LATE, _MAX_LATE = 0.1, 1.0
#: Most topics that a line names.
_MAX_NAMED = 3


class Pace:
    """Converts between recorded time and monotonic time. Recorded time stands still during a pause.

    Args:
        start: Recorded time at the start, nanoseconds.
        rate: Recorded seconds per second.
        now: Monotonic time at the start, seconds.
    """

    def __init__(self, start: int, rate: float, now: float) -> None:
        self._recorded, self._rate, self._since = start, rate, now
        self.paused = False

    def recorded(self, now: float) -> int:
        """Recorded time at a monotonic time, nanoseconds."""
        return (
            self._recorded if self.paused else self._recorded + round((now - self._since) * self._rate * 1e9)
        )

    def seconds_until(self, recorded: int, now: float) -> float:
        """Seconds until a recorded time is due. Infinite during a pause, negative once it has passed."""
        if self.paused:
            return float("inf")
        return self._since - now + (recorded - self._recorded) * 1e-9 / self._rate

    def toggle_pause(self, now: float) -> None:
        """Begin or end a pause."""
        self._recorded, self._since = self.recorded(now), now
        self.paused = not self.paused


class BagPlayer:
    """Publishes the messages of a bag. Call :meth:`close` at the end. ``rclpy`` must be initialised.

    Args:
        path: Folder of the bag, or one file of it.
        options: Options of the player.

    Attributes:
        topics: Names of the topics that are played.
        seconds: Duration of the bag.
        played: Number of messages that were sent.

    Raises:
        HumansimError: The path is no bag or has no messages to play, or another node publishes ``/clock``.
    """

    def __init__(self, path: str | os.PathLike[str], options: PlayOptions) -> None:
        self._path, self._options = Path(path), options
        self._reader = BagReader(path)
        chosen = self._chosen()
        types = self._types(chosen)
        self.topics = [topic.name for topic in chosen.values() if topic.name in types]
        self._start, self._end = self._interval()
        self.seconds = (self._end - self._start) * 1e-9
        self.played = 0
        self._last_clock = -1
        self._node = GuardedNode("bag_player")
        self._executor = make_executor()
        self._executor.add_node(self._node)
        plays_clock = bool(options.clock) or CLOCK_TOPIC in self.topics
        try:
            owner = ClockOwner(self._node, CLOCK_SEARCH) if plays_clock else None
            while owner is not None and (other := owner.check()) is None:
                self._executor.spin_once(_STEP)
            if owner is not None:
                if other:
                    raise RosError(other)
                owner.close()
            self._publishers = {
                number: self._node.create_publisher(
                    types[topic.name], topic.name, publisher_profile(topic.qos)
                )
                for number, topic in chosen.items()
                if topic.name in types
            }
            self._clock = self._node.create_publisher(Clock, CLOCK_TOPIC, 10) if options.clock else None
            #: Sizes of the messages that were sent without a pause and are not confirmed, by publisher
            #: number.
            self._unconfirmed: dict[int, list[int]] = {number: [] for number in self._publishers}
            self._wait_for_subscribers()
            self._check_neighbours()
        except BaseException:
            self.close()
            raise

    # --- choice of messages

    def _chosen(self) -> Mapping[int, BagTopic]:
        """Topics to play, by number."""
        choice = TopicChoice.of(self._options.topics)
        names = [topic.name for topic in self._reader.topics]
        if unmatched := choice.unmatched(names):
            text = f"has no topic {unmatched[0]}{similar(unmatched[0], names) or _listed(names)}"
            raise RosError(text, path=self._path)
        clock = CLOCK_TOPIC if self._options.clock else ""
        topics = {
            number: topic
            for number, topic in enumerate(self._reader.topics)
            if topic.name != clock and (choice.has(topic.name) or not choice.patterns)
        }
        if not topics:
            raise RosError("the bag has no topics to play", path=self._path)
        return topics

    def _types(self, topics: Mapping[int, BagTopic]) -> dict[str, Any]:
        """Message classes of the topics. Warns of topics with types that are not installed."""
        types = {}
        for topic in topics.values():
            try:
                types[topic.name] = message_type(topic.type)
            except RosError as error:
                warnings.warn(f"{topic.name} is not played: {error}", HumansimWarning, stacklevel=2)
        if not types:
            raise RosError("no type of its topics is installed here", path=self._path)
        return types

    def _interval(self) -> tuple[int, int]:
        """First and last recorded time to play, nanoseconds."""
        info = self._reader.info
        if info.start is None or info.end is None:
            raise RosError("the bag has no messages", path=self._path)
        start = info.start + round(self._options.start_offset * 1e9)
        if start > info.end:
            length = (info.end - info.start) * 1e-9
            text = f"the bag lasts {length:.3f} s: nothing is left after {self._options.start_offset:g} s"
            raise RosError(text, path=self._path)
        return start, info.end

    # --- other nodes

    def _wait_for_subscribers(self) -> None:
        """Wait until the publishers have found all existing subscriptions."""
        begin = changed = time.monotonic()
        found = -1
        while time.monotonic() < min(changed + _QUIET, begin + _MAX_QUIET):
            number = sum(self._node.count_subscribers(publisher.topic_name) for publisher in self._all())
            number += sum(publisher.get_subscription_count() for publisher in self._all())
            if number != found:
                found, changed = number, time.monotonic()
            self._executor.spin_once(_STEP)

    def _check_neighbours(self) -> None:
        """Warn of other nodes that publish topics of the bag."""
        topics = [each.topic_name for each in self._all()]
        others = [topic for topic in topics if self._node.count_publishers(topic) > 1]
        if others:
            text = "other nodes publish topics of the bag, and their messages mix"
            warnings.warn(f"{text}: {some_of(others, _MAX_NAMED)}", HumansimWarning, stacklevel=2)

    def _all(self) -> Iterator[Any]:
        yield from self._publishers.values()
        if self._clock is not None:
            yield self._clock

    # --- playing

    def play(self, key: Callable[[], str] = lambda: "") -> None:
        """Publish all messages, and wait until subscribers have them. ``key``: returns the key that was
        pressed since the last call, or an empty text. Space pauses."""
        sent = self._send_latched()
        while True:
            self._play_once(sent, key)
            if not self._options.loop:
                break
            sent = {}
            self._last_clock = -1
        self._wait_for_delivery()

    def _play_once(self, sent: Mapping[int, int], key: Callable[[], str]) -> None:
        """Publish all messages once. ``sent``: by latched topic, time up to which messages are already
        sent."""
        pace = Pace(self._start, self._options.rate, time.monotonic())
        self._next_clock = 0.0
        warned = False
        for message in self._reader.messages(topics=self.topics, start=self._start):
            if message.topic not in self._publishers or message.stamp <= sent.get(message.topic, -1):
                continue
            late = -self._wait(pace, message.stamp, key)
            if late > _MAX_LATE and not warned:
                warned = True
                text = f"messages are {late:.1f} s late: this machine is too slow for this bag and rate"
                warnings.warn(text, HumansimWarning, stacklevel=2)
            self._publish(message, late > _LATE)
        self._publish_clock(self._end)

    def _wait(self, pace: Pace, recorded: int, key: Callable[[], str]) -> float:
        """Wait until a recorded time. Returns the seconds that are left until this time, negative once it has
        passed."""
        first = None
        while True:
            if key() == " ":
                pace.toggle_pause(time.monotonic())
            now = time.monotonic()
            if self._clock is not None and now >= self._next_clock:
                self._next_clock = max(self._next_clock + 1 / self._options.clock, now)
                self._publish_clock(min(pace.recorded(now), recorded))
            left = pace.seconds_until(recorded, now)
            first = left if first is None else first
            if left <= 0:
                return first
            until_clock = self._next_clock - now if self._clock is not None else left
            time.sleep(max(0.0, min(left, until_clock, _STEP)))

    def _publish_clock(self, stamp: int) -> None:
        if self._clock is not None and stamp > self._last_clock:
            self._last_clock = stamp
            self._clock.publish(Clock(clock=to_time(stamp)))

    def _send_latched(self) -> dict[int, int]:
        """Publish the messages of latched topics that a subscriber would have got at the time of the start;
        for a topic that begins later, its first message. Returns the time of the last message by topic."""
        profiles = {number: publisher_profile(self._reader.topics[number].qos) for number in self._publishers}
        latched = {
            number: deque[BagMessage](maxlen=profile.depth)
            for number, profile in profiles.items()
            if profile.durability == QoSDurabilityPolicy.TRANSIENT_LOCAL
        }
        names = [self._reader.topics[number].name for number in latched]
        for message in self._reader.messages(topics=names) if names else ():
            held = latched[message.topic]
            if message.stamp <= self._start or not held:
                held.append(message)
            elif all(latched.values()):
                break
        sent = {}
        for number, held in latched.items():
            for message in held:
                self._publish(message)
                sent[number] = message.stamp
        return sent

    def _publish(self, message: BagMessage, is_late: bool = False) -> None:
        """Publish a message. ``is_late``: whether messages are sent without a pause, so that subscribers
        might lose some. Then wait from time to time until subscribers have confirmed them."""
        publisher = self._publishers[message.topic]
        publisher.publish(bytes(message.data))
        self.played += 1
        unconfirmed = self._unconfirmed[message.topic]
        if not is_late:
            unconfirmed.clear()
        unconfirmed.append(len(message.data))
        if len(unconfirmed) >= _MAX_AT_ONCE or sum(unconfirmed) > _MAX_UNCONFIRMED:
            unconfirmed.clear()
            _wait_until_acknowledged(publisher, _DELIVERY)

    def _wait_for_delivery(self) -> None:
        end = time.monotonic() + _DELIVERY
        missing = [
            publisher.topic_name
            for publisher in self._all()
            if not _wait_until_acknowledged(publisher, end - time.monotonic())
        ]
        time.sleep(_LINGER)
        if missing:
            text = f"subscribers have not confirmed the last messages of {some_of(missing, _MAX_NAMED)}"
            warnings.warn(text, HumansimWarning, stacklevel=2)

    def close(self) -> None:
        """Close the bag, and destroy the node."""
        self._reader.close()
        with suppress(Exception):  # the context may be invalid already
            self._node.destroy_node()


def _wait_until_acknowledged(publisher: Any, seconds: float) -> bool:
    """Wait until all reliable subscribers have confirmed all messages. Returns False if this takes longer
    than ``seconds``."""
    end = time.monotonic() + seconds
    # signals are not handled during this call
    while not publisher.wait_for_all_acked(Duration(seconds=_STEP)):
        if time.monotonic() > end:
            return False
    return True


def _listed(names: Sequence[str]) -> str:
    return f"; it has {some_of(names, _MAX_NAMED)}" if names else ""
