"""Collect messages into frames, and find out which frames are whole, that is complete.

A frame is all messages with the same stamp. :class:`Frames` collects messages and tells which frames are
whole, which topics are missing, and which messages belong to a stamp. Stamps are nanoseconds. Arrival times
are seconds of a monotonic clock of the caller.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Callable, Collection, Iterable, Sequence
from itertools import pairwise
from statistics import median_low
from threading import RLock
from typing import Generic, TypeVar

Content = TypeVar("Content")

#: Used as the stamp of a message that has no stamp.
_NO_STAMP = -1
#: A message that is older than a frame by more than this (nanoseconds) does not belong to the frame, even if
#: there is no newer message.
_OLDEST = 10**9
#: Frames no longer wait for a topic that has had no message for this time, seconds.
_SILENT = 1.0


def place_at(stamps: Sequence[int], stamp: int, half: int, lasts: bool, oldest: int = _OLDEST) -> int | None:
    """Find the message that belongs to a frame. Returns its index, or None for no message.

    The message with the stamp of the frame is taken. If there is none, the nearest message within half a
    period is taken, or else the last message before the frame, unless it is too old. If ``lasts``: the last
    message up to the stamp, or else the first message.

    Args:
        stamps: Stamps of the messages in ascending order.
        stamp: Stamp of the frame.
        half: Half a period of the frames, nanoseconds.
        lasts: Whether a message is valid until the next one, however late that comes.
        oldest: Nanoseconds after which a message before the frame is old.
    """
    after = bisect_right(stamps, stamp)
    before = after - 1
    if lasts:
        return max(before, 0) if stamps else None
    near = [number for number in (before, after) if 0 <= number < len(stamps)]
    nearest = min(near, key=lambda number: abs(stamps[number] - stamp), default=None)
    if nearest is not None and abs(stamps[nearest] - stamp) <= half:
        return nearest
    return before if before >= 0 and stamp - stamps[before] <= oldest else None


def due_stamps(stamps: Sequence[int], own: Sequence[int]) -> set[int]:
    """Return the stamps of the frames that a camera captures, for a camera with its own steady rate.

    Frames with a lost picture are included. They are found where the gap between two pictures is a multiple
    of the median interval. With fewer than two pictures the rate is unknown, and the camera is assumed to
    capture each frame.

    Args:
        stamps: Stamps of all frames in ascending order.
        own: Stamps of the pictures that have arrived from the camera, in ascending order.
    """
    if len(own) < 2 or len(stamps) < 2:
        return set(stamps)
    period = median_low(after - before for before, after in pairwise(own))
    steps = sorted(after - before for before, after in pairwise(stamps))
    half = steps[len(steps) // 10] / 2  # a few stamps may come from a clock that was set

    def is_due(stamp: int) -> bool:
        place = bisect_left(own, stamp)
        nearest = min(own[max(0, place - 1) : place + 1], key=lambda each: abs(each - stamp))
        periods = abs(stamp - nearest) / period
        return abs(periods - round(periods)) * period < half

    return {stamp for stamp in stamps if is_due(stamp)}


class Frames(Generic[Content]):
    """Messages by stamp and topic. A frame is whole when each required topic has a message.

    If a limit is exceeded, frames are removed, first the one that has had no new message for the longest
    time. Several threads may add and read messages at the same time.

    Args:
        required: Topics that must have a message before a frame is whole.
        max_frames: Most frames that are stored. If None, any number.
        max_of_topic: Most messages of a topic that are stored. Messages with the smallest stamps are removed
            first. If None, any number.
        max_size: Greatest sum of the sizes of stored contents. If None, any sum.
        size_of: Function that returns the size of a content.
        new_run: If a stamp of a topic goes back by more than this (nanoseconds), a new run has begun, and all
            frames are removed. If None, stamps may go back.

    Attributes:
        size: Sum of the sizes of all contents.
        forgotten: Number of frames that were removed because of a limit.
    """

    def __init__(
        self,
        required: Iterable[str] = (),
        *,
        max_frames: int | None = None,
        max_of_topic: int | None = None,
        max_size: int | None = None,
        size_of: Callable[[Content], int] = lambda _: 0,
        new_run: int | None = None,
    ) -> None:
        self._required = dict.fromkeys(required)
        #: For topics that only some frames need: the stamps of these frames.
        self._due: dict[str, set[int]] = {}
        self._max_frames, self._max_of_topic, self._max_size = max_frames, max_of_topic, max_size
        self._size_of, self._new_run = size_of, new_run
        self._lock = RLock()
        #: Messages by stamp and topic. The frame that got a message last is at the end.
        self._frames: dict[int, dict[str, Content]] = {}
        #: Messages of :meth:`keep`, by topic and stamp. A stamp with only such messages is no frame, and
        #: their size has no limit.
        self._lasting: dict[str, dict[int, Content]] = {}
        #: Stamps of the messages of each topic in ascending order.
        self._stamps: dict[str, list[int]] = {}
        #: By topic: stamp and arrival time of the message that arrived last.
        self._heard: dict[str, tuple[int, float]] = {}
        self.size = self.forgotten = 0

    def __len__(self) -> int:
        return len(self._frames)

    def require(self, topic: str, required: bool = True) -> None:
        """Set whether a topic is required for whole frames."""
        with self._lock:
            if required:
                self._required[topic] = None
            else:
                self._required.pop(topic, None)

    def require_when_due(self, topics: Collection[str]) -> set[int]:
        """Require the topics of a camera only in the frames that the camera captures.

        These frames are estimated from the stamps of the stored messages (:func:`due_stamps`).

        Returns:
            The stamps of these frames.
        """
        with self._lock:
            due = due_stamps(self.stamps(), self.stamps(topics))
            self._due |= dict.fromkeys(topics, due)
        return due

    # --- messages

    def add(self, topic: str, stamp: int, content: Content, arrival: float = 0.0) -> bool:
        """Add a message. It replaces an earlier message with the same topic and stamp.

        Args:
            topic: Topic of the message, required or not.
            stamp: Stamp of the message.
            content: Content of the message.
            arrival: Time of its arrival.

        Returns:
            Whether the frame of the message is whole now.
        """
        with self._lock:
            if topic in self._lasting:
                self.forget(topic)
            self._heard[topic] = stamp, arrival
            stamps = self._stamps.setdefault(topic, [])
            if self._new_run is not None and stamps and stamp < stamps[-1] - self._new_run:
                self.clear()
            frame = self._frames[stamp] = self._frames.pop(stamp, {})
            if topic in frame:
                self.size -= self._size_of(frame.pop(topic))
            else:
                insort(stamps, stamp)
            frame[topic] = content
            self.size += self._size_of(content)
            self._limit(topic)
            return self.is_whole(stamp)

    def keep(self, topic: str, stamp: int | None, content: Content, arrival: float = 0.0) -> None:
        """Add a message that is valid until the next one of its topic, however late that comes.

        Args:
            topic: Topic of the message. All messages of this topic must be added with this method.
            stamp: Stamp of the message. If None, the message has no stamp and replaces the previous message.
            content: Content of the message.
            arrival: Time of its arrival.
        """
        key = _NO_STAMP if stamp is None else stamp
        with self._lock:
            if topic not in self._lasting:
                self.forget(topic)
            self._heard[topic] = key, arrival
            held = self._lasting.setdefault(topic, {})
            if key not in held:
                insort(self._stamps.setdefault(topic, []), key)
            held[key] = content
            self._limit(topic)

    def _limit(self, topic: str) -> None:
        stamps = self._stamps[topic]
        while self._max_of_topic is not None and len(stamps) > self._max_of_topic:
            self._remove(topic, stamps[0])
        while len(self._frames) > 1 and (
            (self._max_frames is not None and len(self._frames) > self._max_frames)
            or (self._max_size is not None and self.size > self._max_size)
        ):
            self.pop(next(iter(self._frames)))
            self.forgotten += 1

    def _remove(self, topic: str, stamp: int) -> None:
        """Remove a message. Remove its frame, too, if the frame has no other message."""
        stamps = self._stamps[topic]
        del stamps[bisect_left(stamps, stamp)]
        if topic in self._lasting:
            del self._lasting[topic][stamp]
            return
        frame = self._frames[stamp]
        self.size -= self._size_of(frame.pop(topic))
        if not frame:
            del self._frames[stamp]

    def pop(self, stamp: int) -> dict[str, Content]:
        """Remove a frame and return its messages by topic."""
        with self._lock:
            frame = dict(self._frames[stamp])
            for topic in frame:
                self._remove(topic, stamp)
            return frame

    def forget(self, topic: str) -> None:
        """Remove all messages of a topic."""
        with self._lock:
            for stamp in list(self._stamps.get(topic, ())):
                self._remove(topic, stamp)
            self._heard.pop(topic, None)
            self._lasting.pop(topic, None)

    def clear(self) -> None:
        """Remove all frames, but not the messages of :meth:`keep`."""
        with self._lock:
            for stamp in list(self._frames):
                self.pop(stamp)

    # --- frames

    def frame(self, stamp: int) -> dict[str, Content]:
        """Return the messages with a stamp by topic, in the order of their arrival; empty if there are
        none."""
        with self._lock:
            return dict(self._frames.get(stamp, {}))

    def stamps(self, topics: Collection[str] | None = None) -> list[int]:
        """Return the stamps of frames in ascending order. If ``topics`` are given, only frames with messages
        of these topics count."""
        with self._lock:
            if topics is None:
                return sorted(self._frames)
            found = {stamp for topic in topics for stamp in self._stamps.get(topic, ())}
            return sorted(found - {_NO_STAMP})

    def is_whole(self, stamp: int) -> bool:
        """Return whether a frame has a message of each required topic."""
        if stamp not in self._frames:
            return False
        missing = self._required.keys() - self._frames[stamp].keys()
        return all(stamp not in self._due.get(topic, (stamp,)) for topic in missing)

    def whole(self) -> list[int]:
        """Return the stamps of whole frames in ascending order."""
        with self._lock:
            return sorted(filter(self.is_whole, self._frames))

    def lacking(self) -> dict[str, int]:
        """Return the required topics that some frames lack, and for each topic the number of these frames."""
        with self._lock:
            counts = {
                topic: len(self._due.get(topic, self._frames)) - len(self._stamps.get(topic, ()))
                for topic in self._required
            }
        return {topic: count for topic, count in counts.items() if count}

    def newest_whole(
        self, clock: Collection[str], needed: Collection[str], patience: int, now: float
    ) -> int | None:
        """Return the stamp of the newest frame that has a message of each needed topic. Topics without a
        message for one second are ignored.

        A topic with a lower steady rate than the frames is needed only in some of the frames.

        Args:
            clock: Topics that define the frames: each stamp of their messages is a frame.
            needed: Topics that a whole frame must have.
            patience: A whole frame may be older than the newest frame by at most this time, nanoseconds.
            now: Present time, on the same clock as ``arrival``.

        Returns:
            The stamp. If no frame is whole and new enough, that of the newest frame. None without frames.
        """
        with self._lock:
            stamps = self.stamps(clock)
            alive = {
                topic for topic in needed if self._stamps.get(topic) and now - self._heard[topic][1] < _SILENT
            }
            due: dict[str, set[int]] = {}
            for stamp in reversed(stamps):
                if stamps[-1] - stamp > patience:
                    break
                missing = alive - self._frames.get(stamp, {}).keys()
                due |= {topic: due_stamps(stamps, self._stamps[topic]) for topic in missing - due.keys()}
                if all(stamp not in due[topic] for topic in missing):
                    return stamp
            return stamps[-1] if stamps else None

    def near(self, stamp: int, topics: Iterable[str], half: int, oldest: int = _OLDEST) -> dict[str, Content]:
        """Return the messages that belong to a frame, by topic. :func:`place_at` finds them.

        Args:
            stamp: Stamp of the frame.
            topics: Topics that are wanted.
            half: Half a period of the frames, nanoseconds.
            oldest: Nanoseconds after which a message before the frame is old.
        """
        with self._lock:
            found = {}
            for topic in topics:
                stamps = self._stamps.get(topic, [])
                place = place_at(stamps, stamp, half, topic in self._lasting, oldest)
                if place is not None:
                    found[topic] = self._content(topic, stamps[place])
            return found

    def first(self) -> dict[str, Content]:
        """Return the message with the smallest stamp of each topic."""
        return self._of_each(0)

    def newest(self) -> dict[str, Content]:
        """Return the message with the greatest stamp of each topic."""
        return self._of_each(-1)

    def _of_each(self, place: int) -> dict[str, Content]:
        with self._lock:
            found = {topic: stamps[place] for topic, stamps in self._stamps.items() if stamps}
            return {topic: self._content(topic, stamp) for topic, stamp in found.items()}

    def _content(self, topic: str, stamp: int) -> Content:
        return self._lasting[topic][stamp] if topic in self._lasting else self._frames[stamp][topic]

    def silence(self, topics: Collection[str], now: float) -> float | None:
        """Return the seconds since the last message of any of the topics; None if no message has arrived."""
        with self._lock:
            heard = [self._heard[topic][1] for topic in topics if topic in self._heard]
        return now - max(heard) if heard else None
