"""Frames of a recording in lockstep."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from hashlib import blake2b

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
        #: By topic: newest stamp, and how many times each digest of a message with this stamp has come.
        self._messages: dict[str, tuple[int, Counter[bytes]]] = {}
        #: Awaited topics, except those of nodes that have ended.
        self._alive = set(self.awaited)
        self.newest = 0
        self._resting: Collection[str] = ()
        self._is_whole = False

    def _last(self, topic: str) -> tuple[int, Counter[bytes]]:
        return self._messages.get(topic, (-1, Counter()))

    @property
    def missing(self) -> list[str]:
        """Awaited topics that have not delivered the newest frame."""
        behind = {topic for topic in self._alive if self._last(topic)[0] < self.newest}
        return sorted(behind.difference(self._resting))

    def begin(self, stamp: int, resting: Collection[str] = ()) -> None:
        """Note that the player has sent a frame. ``resting``: awaited topics that have no message in this
        frame."""
        if stamp == self.newest and resting:
            self._resting = resting
        if stamp > self.newest:
            # before the first frame, no node had the time to answer
            self._alive.difference_update(self.missing if self.newest else ())
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
        last, digests = self._last(topic)
        if topic in self._per_frame:
            if stamp <= last:
                return False
            self.begin(stamp)
            digests = Counter()
        elif stamp < last:
            return True
        else:
            digests = digests if stamp == last else Counter()
            digest = blake2b(data, digest_size=_DIGEST).digest()
            digests[digest] += 1
            if digests[digest] > self._copies(topic, stamp):
                return False
        self._messages[topic] = stamp, digests
        if topic in self.awaited:
            self._alive.add(topic)
        return True

    def take_whole(self) -> int | None:
        """Return the stamp of the newest frame if it has become whole since the last call; else None."""
        if self._is_whole or not self.newest or self.missing:
            return None
        self._is_whole = True
        return self.newest
