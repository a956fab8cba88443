"""Frames of a running graph that a node takes, one after the other."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from humansim_ros.data.messages.frames import Frames

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
