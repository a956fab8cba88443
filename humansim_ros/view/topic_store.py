"""The newest messages of topics, and the frame among them that is whole."""

from __future__ import annotations

import time
from bisect import bisect_right
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from threading import Lock
from typing import Any

#: Most bytes of all messages, and most messages of a topic.
MAX_BYTES, MAX_MESSAGES = 512 << 20, 90
#: Nanoseconds after which a message that is not replaced belongs to no frame: images, and people.
_OLDEST = 10**9
#: Seconds without a message after which frames do not wait for a topic.
_SILENT = 1.0
#: Nanoseconds by which stamps of a topic go back when a new run begins.
_NEW_RUN = 10**9


def place_at(stamps: Sequence[int] | Any, stamp: int, half: int, lasts: bool) -> int | None:
    """Number of the message that belongs to a frame; None if there is none.

    That of its stamp; else the nearest within half a period; else the last one before it, unless it is old.
    For a topic whose messages last: the last one up to the stamp, or the first one.

    Args:
        stamps: Stamps of the messages in ascending order, nanoseconds.
        stamp: That of the frame.
        half: Half a period of the frames, nanoseconds.
        lasts: A message holds until the next one, however long that takes.
    """
    after = bisect_right(stamps, stamp)
    before = after - 1
    if lasts:
        return max(before, 0) if len(stamps) else None
    near = [number for number in (before, after) if 0 <= number < len(stamps)]
    nearest = min(near, key=lambda number: abs(int(stamps[number]) - stamp), default=None)
    if nearest is not None and abs(int(stamps[nearest]) - stamp) <= half:
        return nearest
    return before if before >= 0 and stamp - int(stamps[before]) <= _OLDEST else None


class TopicStore:
    """The newest messages of each topic; one thread adds them, and another one takes them.

    Memory is bounded: the messages that arrived first are forgotten. Messages whose stamps go back by more
    than a second begin a new run: all others are forgotten. Neither holds for messages that last.

    ``max_bytes``: most bytes of messages that are kept, without those that last.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._max_bytes = max_bytes
        self._lock = Lock()
        #: Messages by topic and stamp in ascending order; those without stamp have the stamp -1.
        self._messages: dict[str, dict[int, bytes]] = {}
        #: Topic and stamp of each message that does not last, in the order of arrival.
        self._order: deque[tuple[str, int]] = deque()
        self._lasting: set[str] = set()
        self._heard: dict[str, float] = {}
        self.size = 0

    def add(self, topic: str, stamp: int | None, data: bytes, lasts: bool = False) -> None:
        """Keep a message; of several with one stamp the last.

        Args:
            topic: Its topic.
            stamp: Nanoseconds; None if it has none: it lasts, and replaces the last one.
            data: Serialised message.
            lasts: It holds until the next one, however long that takes.
        """
        with self._lock:
            self._heard[topic] = time.monotonic()
            key = -1 if stamp is None else stamp
            lasts = lasts or stamp is None
            if lasts:
                self._lasting.add(topic)
            of_topic = self._messages.setdefault(topic, {})
            if not lasts and of_topic and key < next(reversed(of_topic)) - _NEW_RUN:
                self._begin_run()
            if key in of_topic:
                self._remove(topic, key)
            is_last = not of_topic or key > next(reversed(of_topic))
            of_topic[key] = data
            if not lasts:
                self._order.append((topic, key))
                self.size += len(data)
            if not is_last:
                self._messages[topic] = dict(sorted(of_topic.items()))
            if len(of_topic) > MAX_MESSAGES:
                self._remove(topic, next(iter(self._messages[topic])))
            while self.size > self._max_bytes and len(self._order) > 1:
                self._remove(*self._order[0])

    def forget(self, topic: str) -> None:
        """Forget a topic."""
        with self._lock:
            for stamp in list(self._messages.get(topic, {})):
                self._remove(topic, stamp)
            self._heard.pop(topic, None)
            self._lasting.discard(topic)

    def _begin_run(self) -> None:
        while self._order:
            self._remove(*self._order[0])

    def _remove(self, topic: str, stamp: int) -> None:
        data = self._messages[topic].pop(stamp)
        if topic not in self._lasting:
            self._order.remove((topic, stamp))
            self.size -= len(data)

    def newest(self) -> dict[str, bytes]:
        """The newest message of each topic."""
        with self._lock:
            return {topic: found[next(reversed(found))] for topic, found in self._messages.items() if found}

    def stamps(self, topics: Collection[str]) -> list[int]:
        """Stamps of the messages of some topics in ascending order, each once."""
        with self._lock:
            return self._stamps(topics)

    def _stamps(self, topics: Collection[str]) -> list[int]:
        return sorted({stamp for topic in topics for stamp in self._messages.get(topic, ()) if stamp >= 0})

    def silence(self, topics: Collection[str]) -> float | None:
        """Seconds since the last message of some topics; None if none has arrived."""
        with self._lock:
            heard = [self._heard[topic] for topic in topics if topic in self._heard]
        return time.monotonic() - max(heard) if heard else None

    def whole_frame(self, clock: Collection[str], needed: Collection[str], patience: int) -> int | None:
        """Stamp of the newest frame of which all topics have a message; the newest one if none has, or if it
        is too old.

        Args:
            clock: Topics whose stamps are frames.
            needed: Topics that a whole frame has; silent ones are not waited for.
            patience: Nanoseconds that a whole frame may be older than the newest one.

        Returns:
            Nanoseconds; None without frames.
        """
        with self._lock:
            stamps = self._stamps(clock)
            if not stamps:
                return None
            now = time.monotonic()
            alive = [
                self._messages[topic]
                for topic in needed
                if self._messages.get(topic) and now - self._heard[topic] < _SILENT
            ]
            for stamp in reversed(stamps):
                if stamps[-1] - stamp > patience:
                    break
                if all(stamp in messages for messages in alive):
                    return stamp
            return stamps[-1]

    def messages_of(self, stamp: int, lasting: Mapping[str, bool], half: int) -> dict[str, bytes]:
        """Messages that belong to a frame by topic.

        Args:
            stamp: Nanoseconds.
            lasting: The topics that are wanted, and whether their messages last.
            half: Half a period of the frames, nanoseconds.
        """
        found = {}
        with self._lock:
            for topic, lasts in lasting.items():
                of_topic = self._messages.get(topic)
                if not of_topic:
                    continue
                if -1 in of_topic:
                    found[topic] = of_topic[-1]
                    continue
                stamps = list(of_topic)
                place = place_at(stamps, stamp, half, lasts)
                if place is not None:
                    found[topic] = of_topic[stamps[place]]
        return found
