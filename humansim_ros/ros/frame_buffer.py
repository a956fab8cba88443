"""Frames whose messages are still arriving, by stamp, and topics whose stamps come from another clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

#: Incomplete frames that are held.
_MAX_INCOMPLETE = 8
#: Intervals between frames from which the period is estimated.
_INTERVALS = 5
#: Periods behind the newest frame after which a frame is late.
_MAX_PERIODS_LATE = 1.5
#: Distance from the present, in nanoseconds and in periods, from which a stamp is of another clock.
_FAR, _FAR_PERIODS = 1_000_000_000, 4
#: Seconds for which the last frame and the last message of a topic tell the present time.
_RECENT = 1.0


@dataclass(frozen=True)
class CompleteFrame:
    """Frame with the messages of all topics.

    Attributes:
        stamp: Nanoseconds.
        contents: By topic.
        skipped: Number of earlier frames that are given up for it.
    """

    stamp: int
    contents: Mapping[str, Any]
    skipped: int


@dataclass(frozen=True)
class GivenUpFrame:
    """Frame that is given up because too many are incomplete.

    Attributes:
        missing: Topics without a message of its stamp.
        offsets: By topic, seconds by which its stamps are ahead of those of the other topics; only topics
            whose stamps are of another clock.
    """

    missing: list[str]
    offsets: dict[str, float]


class FrameBuffer:
    """Holds frames until each required topic has a message with their stamp.

    At most eight incomplete frames are held. The first that are given up are far from the present: they have
    stamps of another clock, such as that of a host whose clock is ahead, and would never be complete. The
    present is the stamp of a frame that has just been complete. Without one, it is the time of the node's
    clock if a held frame agrees with it, and else the median of the topics' newest stamps, as while a
    recording is played.

    A complete frame far before the last one means that the clock was set back (a recording is played again).
    No single message means that: one old stamp does not remove the present frames. The last frame may be
    complete again: in lockstep it is sent again for nodes that have joined.

    Stamps and ``now``, the time of the node's clock, are nanoseconds; ``steady`` is in monotonic seconds.
    """

    def __init__(self, topics: Collection[str], period: float) -> None:
        """``topics``: required ones. ``period``: expected nanoseconds between frames."""
        self._required = dict.fromkeys(topics)
        # that with the newest message last
        self._frames: dict[int, dict[str, Any]] = {}
        # stamp of the newest message of each topic, and its arrival in monotonic seconds
        self._newest: dict[str, tuple[int, float]] = {}
        self._newest_complete = 0
        # nanoseconds between complete frames: the player's rate may differ from the scene's
        self._intervals: deque[float] = deque([period] * _INTERVALS, maxlen=_INTERVALS)
        # last frame that was taken: its stamp, and the node's clock and the monotonic seconds at that time
        self._last: tuple[int, int, float] | None = None

    def require(self, topic: str, required: bool) -> None:
        """Set whether frames are complete only with a message of a topic."""
        if required:
            self._required[topic] = None
        else:
            self._required.pop(topic, None)

    @property
    def has_complete(self) -> bool:
        """Whether a complete frame can be taken."""
        return any(self._is_complete(stamp) for stamp in self._frames)

    @property
    def _period(self) -> float:
        return sorted(self._intervals)[1]  # robust to few reordered or lost frames

    @property
    def _far(self) -> float:
        return max(_FAR, _FAR_PERIODS * self._period)

    def add(self, topic: str, stamp: int, content: Any, steady: float) -> bool:
        """Add the content of a message.

        Args:
            topic: Topic of the message, required or not.
            stamp: Stamp of the message.
            content: What the message says.
            steady: Monotonic seconds.

        Returns:
            Whether its frame is complete now.
        """
        self._newest[topic] = (stamp, steady)
        if self._last is not None and self._last[0] - self._far <= stamp < self._last[0]:
            return False
        frame = self._frames[stamp] = self._frames.pop(stamp, {})
        frame[topic] = content
        if not self._is_complete(stamp):
            return False
        if 0 < stamp - self._newest_complete <= self._far:
            self._intervals.append(stamp - self._newest_complete)
        self._newest_complete = stamp
        return True

    def take(self, newest_if_late: bool, now: int, steady: float) -> CompleteFrame | None:
        """Remove and return the oldest complete frame, if there is one.

        ``newest_if_late``: the oldest that is not late, or the newest one if all are.
        """
        complete = sorted(stamp for stamp in self._frames if self._is_complete(stamp))
        if not complete:
            return None
        stamp, limit, far = complete[0], _MAX_PERIODS_LATE * self._period, self._far
        if newest_if_late:
            stamp = next(s for s in complete if not any(limit < later - s <= far for later in complete))
        contents = self._frames.pop(stamp)
        past = [each for each in self._frames if stamp - far <= each < stamp]
        for each in past:
            del self._frames[each]
        # the last frame again, of which not every message came: it is not lost
        repeated = self._last is not None and self._last[0] in past
        self._last = (stamp, now, steady)
        return CompleteFrame(stamp, contents, len(past) - repeated)

    def give_up(self, now: int, steady: float) -> GivenUpFrame | None:
        """Remove and return an incomplete frame if there are too many.

        It is the one that has waited longest for a message, of those far from the present if there are any.
        """
        incomplete = [stamp for stamp in self._frames if not self._is_complete(stamp)]
        if len(incomplete) <= _MAX_INCOMPLETE:
            return None
        present, far = self._present(now, steady), self._far
        stamp = next((each for each in incomplete if abs(each - present) > far), incomplete[0])
        frame = self._frames.pop(stamp)
        missing = [topic for topic in self._required if topic not in frame]
        if abs(stamp - present) > far:
            offsets = dict.fromkeys(frame, (stamp - present) * 1e-9)
        else:
            offsets = {
                topic: (newest - present) * 1e-9
                for topic, (newest, heard) in self._newest.items()
                if topic in missing and steady - heard <= _RECENT and abs(newest - present) > far
            }
        return GivenUpFrame(missing, offsets)

    def _is_complete(self, stamp: int) -> bool:
        return self._required.keys() <= self._frames[stamp].keys()

    def _present(self, now: int, steady: float) -> int:
        """Stamp of a frame that is sent now."""
        if self._last is not None:
            stamp, then, taken = self._last
            if steady - taken <= _RECENT:
                return stamp + now - then
        if any(abs(stamp - now) <= self._far for stamp in self._frames):
            return now
        stamps = sorted(stamp for stamp, heard in self._newest.values() if steady - heard <= _RECENT)
        return stamps[(len(stamps) - 1) // 2]
