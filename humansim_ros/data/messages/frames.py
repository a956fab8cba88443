"""Collect messages into frames, and find out which frames are whole, that is complete.

A frame is all messages with the same stamp. :class:`Frames` collects messages and tells which frames are
whole, which topics are missing, and which messages belong to a stamp. :class:`PacedFrames` gives the frames
of a running graph to a node, one after the other. :class:`RecordedFrames` tells when a recording in lockstep
has all messages of a frame. Messages are not stored there. Stamps are nanoseconds. Arrival times are seconds
of a monotonic clock of the caller.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b
from itertools import pairwise
from statistics import median_low
from threading import RLock
from typing import Any, Generic, TypeVar

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

    def behind(self, stamp: int) -> list[str]:
        """Return the required topics that have only messages from before ``stamp``."""
        return [topic for topic in self._required if (self._stamps.get(topic) or [_NO_STAMP])[-1] < stamp]

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


# --- of a running graph

#: Most incomplete frames that are stored.
_MAX_INCOMPLETE = 8
#: Number of intervals between frames from which the period is estimated.
_INTERVALS = 5
#: A frame that is this many periods behind the newest frame is late.
_MAX_PERIODS_LATE = 1.5
#: A stamp is taken to be from another clock if it is farther from the present than both this number of
#: nanoseconds and this number of periods.
_FAR, _FAR_PERIODS = 1_000_000_000, 4
#: For this time, seconds, the last frame (or the last message of a topic) tells the present time.
_RECENT = 1.0


@dataclass(frozen=True)
class WholeFrame:
    """A complete frame: it has the messages of all topics.

    Attributes:
        stamp: Nanoseconds.
        contents: Content by topic.
        skipped: Number of earlier frames that are dropped in favour of this frame.
    """

    stamp: int
    contents: Mapping[str, Any]
    skipped: int


@dataclass(frozen=True)
class GivenUpFrame:
    """An incomplete frame that is dropped, since too many frames are incomplete.

    Attributes:
        missing: Topics without a message in this frame.
        offsets: By topic with stamps of another clock: seconds by which they are ahead of the other topics.
    """

    missing: list[str]
    offsets: dict[str, float]


class PacedFrames(Frames[Any]):
    """Frames that a node takes one after the other.

    At most eight incomplete frames are stored. Frames far from the present are dropped first: their stamps
    come from another clock, such as the wrong clock of another host, so they would never be whole. The
    present is estimated from the stamp of the last whole frame if that was taken within a second. Otherwise
    it is the time of the node's clock, if a stored frame has a stamp near it. Otherwise (while a recording is
    played) it is the median of the newest stamps of the topics.

    A whole frame far before the last one means that the clock was set back, for example because a recording
    starts again. A single message is not enough for this, so that one old stamp does not remove the present
    frames. The last frame may become whole a second time, since lockstep repeats it for nodes that have
    joined.

    ``now``: time of the node's clock, nanoseconds. ``steady``: time of a monotonic clock, seconds.
    """

    def __init__(self, topics: Collection[str], period: float) -> None:
        """``topics``: required topics. ``period``: expected time between frames, nanoseconds."""
        super().__init__(topics)
        self._newest_whole = 0
        # nanoseconds between whole frames, since the player's rate may differ from the scene's
        self._intervals: deque[float] = deque([period] * _INTERVALS, maxlen=_INTERVALS)
        # last frame that was taken: its stamp, and the node's clock and the monotonic seconds at that time
        self._last: tuple[int, int, float] | None = None

    @property
    def has_whole(self) -> bool:
        """Whether a whole frame is ready for :meth:`take`."""
        return bool(self.whole())

    @property
    def _period(self) -> float:
        return sorted(self._intervals)[1]  # not affected by a few reordered or lost frames

    @property
    def _far(self) -> float:
        return max(_FAR, _FAR_PERIODS * self._period)

    def add(self, topic: str, stamp: int, content: Any, arrival: float = 0.0) -> bool:
        # a message from shortly before the last frame is too late
        if self._last is not None and self._last[0] - self._far <= stamp < self._last[0]:
            self._heard[topic] = stamp, arrival
            return False
        if not super().add(topic, stamp, content, arrival):
            return False
        if 0 < stamp - self._newest_whole <= self._far:
            self._intervals.append(stamp - self._newest_whole)
        self._newest_whole = stamp
        return True

    def take(self, newest_if_late: bool, now: int, steady: float) -> WholeFrame | None:
        """Remove and return the oldest whole frame; None if no frame is whole. ``newest_if_late``: skip late
        frames, and return the oldest frame that is not late, or the newest one if all are late."""
        whole = self.whole()
        if not whole:
            return None
        stamp, limit, far = whole[0], _MAX_PERIODS_LATE * self._period, self._far
        if newest_if_late:
            stamp = next(s for s in whole if not any(limit < later - s <= far for later in whole))
        contents = self.pop(stamp)
        past = [each for each in self._frames if stamp - far <= each < stamp]
        for each in past:
            self.pop(each)
        # the last frame again, without some of its messages, is not lost
        repeated = self._last is not None and self._last[0] in past
        self._last = (stamp, now, steady)
        return WholeFrame(stamp, contents, len(past) - repeated)

    def give_up(self, now: int, steady: float) -> GivenUpFrame | None:
        """Remove and return an incomplete frame if there are too many; else None. The frame that got no
        message for the longest time is removed. If some frames are far from the present, one of these is
        removed."""
        incomplete = [stamp for stamp in self._frames if not self.is_whole(stamp)]
        if len(incomplete) <= _MAX_INCOMPLETE:
            return None
        present, far = self._present(now, steady), self._far
        stamp = next((each for each in incomplete if abs(each - present) > far), incomplete[0])
        frame = self.pop(stamp)
        missing = [topic for topic in self._required if topic not in frame]
        if abs(stamp - present) > far:
            offsets = dict.fromkeys(frame, (stamp - present) * 1e-9)
        else:
            offsets = {
                topic: (newest - present) * 1e-9
                for topic, (newest, heard) in self._heard.items()
                if topic in missing and steady - heard <= _RECENT and abs(newest - present) > far
            }
        return GivenUpFrame(missing, offsets)

    def _present(self, now: int, steady: float) -> int:
        """Estimate the stamp that a frame has if it is sent now."""
        if self._last is not None:
            stamp, then, taken = self._last
            if steady - taken <= _RECENT:
                return stamp + now - then
        if any(abs(stamp - now) <= self._far for stamp in self._frames):
            return now
        stamps = sorted(stamp for stamp, heard in self._heard.values() if steady - heard <= _RECENT)
        return stamps[(len(stamps) - 1) // 2]


# --- of a recording in lockstep

#: Length of the digest of a message, bytes.
_DIGEST = 16


class RecordedFrames:
    """Tells which frames of a recording in lockstep are whole, and which messages are repetitions. Stamps
    never go back. Only digests of messages are stored.

    The player sends a frame again for nodes that have joined, so messages come twice. A frame is whole when
    every awaited topic has delivered the stamp of the frame or a newer one. If a topic was missing in a frame
    and the player has gone on, its node is taken to have ended. The topic is not awaited until it delivers
    again.

    Args:
        per_frame: Topics of the scene that have one message for each frame.
        awaited: Other topics that must deliver a message for each frame.
        copies: Function that returns how many times a message is sent, for a topic that is not in
            ``per_frame`` and a stamp.

    Attributes:
        awaited: Topics that must deliver a message for each frame.
        newest: Stamp of the newest frame; 0 before the first.
    """

    def __init__(
        self,
        per_frame: Collection[str],
        awaited: Collection[str] = (),
        copies: Callable[[str, int], int] = lambda *_: 1,
    ) -> None:
        self._per_frame, self.awaited = frozenset(per_frame), frozenset([*per_frame, *awaited])
        self._copies = copies
        #: By topic: digests of the messages with the newest stamp, and how many times each digest has come.
        self._messages: Frames[Counter[bytes]] = Frames(self.awaited, max_of_topic=1)
        self.newest = 0
        self._resting: Collection[str] = ()
        self._is_whole = False

    @property
    def missing(self) -> list[str]:
        """Awaited topics that have not delivered the newest frame."""
        return sorted(set(self._messages.behind(self.newest)).difference(self._resting))

    def begin(self, stamp: int, resting: Collection[str] = ()) -> None:
        """Note that the player has sent a frame. ``resting``: awaited topics that have no message in this
        frame."""
        if stamp == self.newest and resting:
            self._resting = resting
        if stamp > self.newest:
            # before the first frame, no node had the time to answer
            for topic in self.missing if self.newest else ():
                self._messages.require(topic, False)
            self.newest, self._resting = stamp, resting
            self._is_whole = False

    def is_finished(self, stamp: int) -> bool:
        """Return whether :meth:`take_whole` has returned this stamp."""
        return self._is_whole and stamp == self.newest

    def add(self, topic: str, stamp: int, data: bytes) -> bool:
        """Note that a message has arrived. Returns whether the message is new, not a repetition.

        A message of a topic in ``per_frame`` is a repetition if its stamp has come before. A message of
        another topic is a repetition if the same bytes have already come as many times as ``copies`` says.

        Args:
            topic: Topic of the message.
            stamp: Stamp of its header.
            data: The serialised message.
        """
        last = max(self._messages.stamps([topic]), default=-1)
        digests = Counter[bytes]()
        if topic in self._per_frame:
            if stamp <= last:
                return False
            self.begin(stamp)
        elif stamp < last:
            return True
        else:
            if stamp == last:
                digests = self._messages.frame(stamp)[topic]
            digest = blake2b(data, digest_size=_DIGEST).digest()
            digests[digest] += 1
            if digests[digest] > self._copies(topic, stamp):
                return False
        self._messages.add(topic, stamp, digests)
        if topic in self.awaited:
            self._messages.require(topic)
        return True

    def take_whole(self) -> int | None:
        """Return the stamp of the newest frame if it has become whole since the last call; else None."""
        if self._is_whole or not self.newest or self.missing:
            return None
        self._is_whole = True
        return self.newest
