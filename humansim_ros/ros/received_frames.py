"""Frames of a recording in lockstep: which are whole, and which messages have come before."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from hashlib import blake2b

#: Bytes of a digest of a message.
_DIGEST = 16


class ReceivedFrames:
    """Keeps account of the messages of frames, whose stamps never go back.

    The player sends a frame again for nodes that have joined, so messages come twice. A frame is whole when
    every awaited topic has delivered its stamp or a newer one. A topic that was missing in a frame that the
    player has left is not awaited until it delivers again: its node is gone.

    Args:
        per_frame: Topics of the scene, which have one message for each stamp.
        awaited: Other topics that have to deliver each stamp.
        copies: Returns how often a message of another topic and stamp is sent.

    Attributes:
        newest: Stamp of the newest frame, nanoseconds; 0 before the first.
    """

    def __init__(
        self,
        per_frame: Collection[str],
        awaited: Collection[str] = (),
        copies: Callable[[str, int], int] = lambda *_: 1,
    ) -> None:
        self._copies = copies
        self._per_frame = frozenset(per_frame)
        self._awaited = self._per_frame | frozenset(awaited)
        self._last: dict[str, int] = {}
        self._absent: set[str] = set()
        #: Digests of the messages of other topics at their newest stamp, with their number.
        self._digests: dict[str, Counter[bytes]] = {}
        self.newest = 0
        self._is_whole = False

    @property
    def missing(self) -> list[str]:
        """Awaited topics that have not delivered the newest frame."""
        return sorted(self._behind() - self._absent)

    def begin(self, stamp: int) -> None:
        """Note that the player has sent a frame."""
        if stamp > self.newest:
            if self.newest:  # before the first frame, nobody has had the time to deliver
                self._absent |= self._behind()
            self.newest = stamp
            self._is_whole = False

    def is_finished(self, stamp: int) -> bool:
        """Whether :meth:`take_whole` has returned this stamp."""
        return self._is_whole and stamp == self.newest

    def add(self, topic: str, stamp: int, data: bytes) -> bool:
        """Note a message; whether it is new.

        Messages of topics per frame are repeated if their stamp is, those of other topics if the same bytes
        have come as often as they are sent.

        Args:
            topic: Its topic.
            stamp: Stamp of its header, nanoseconds.
            data: The serialised message.
        """
        last = self._last.get(topic, -1)
        if topic in self._per_frame:
            if stamp <= last:
                return False
            self.begin(stamp)
        elif stamp < last:
            return True
        elif not self._is_new_content(topic, data, stamp):
            return False
        self._last[topic] = stamp
        self._absent.discard(topic)
        return True

    def take_whole(self) -> int | None:
        """Stamp of the newest frame if it has become whole since the last call."""
        if self._is_whole or not self.newest or self.missing:
            return None
        self._is_whole = True
        return self.newest

    def _behind(self) -> set[str]:
        return {topic for topic in self._awaited if self._last.get(topic, -1) < self.newest}

    def _is_new_content(self, topic: str, data: bytes, stamp: int) -> bool:
        digest = blake2b(data, digest_size=_DIGEST).digest()
        known = self._digests.setdefault(topic, Counter())
        if stamp > self._last.get(topic, -1):
            known.clear()
        known[digest] += 1
        return known[digest] <= self._copies(topic, stamp)
