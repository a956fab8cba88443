"""How often a faulty camera sends an image: a recorder must tell copies from frames that come again."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

from humansim_ros.scene.faults import FaultSchedule

#: Frames whose images are remembered: late images come after those of newer frames.
_REMEMBERED = 1000
#: Most copies of an image that faults make.
_MOST = 2


class ImageCopies:
    """Number of copies of the message of a topic and stamp.

    Args:
        schedules: Faults by topic, of topics whose messages may be sent twice.
    """

    def __init__(self, schedules: Mapping[str, FaultSchedule]) -> None:
        self._schedules = schedules
        self._known: dict[str, dict[int, int]] = defaultdict(dict)

    def __bool__(self) -> bool:
        """Whether there are such topics."""
        return bool(self._schedules)

    def note(self, stamp: int, scene_time: int) -> None:
        """Note that a frame has begun. ``stamp``, ``scene_time``: nanoseconds."""
        for topic, schedule in self._schedules.items():
            faults, known = schedule.at_time(scene_time), self._known[topic]
            known[faults.stamp(stamp)] = len(faults.sent)
            if len(known) > _REMEMBERED:
                del known[next(iter(known))]

    def __call__(self, topic: str, stamp: int) -> int:
        """Copies of the message of a topic with a stamp; the most if its frame has not been noted yet."""
        if topic not in self._schedules:
            return 1
        return self._known[topic].get(stamp, _MOST)
