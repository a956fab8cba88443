"""Write messages into a bag in a thread, so that a slow disk does not delay the node that receives them."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeAlias

from humansim_ros.data.bags.chunks import BagMessage, Compression, encode_chunk
from humansim_ros.data.bags.topics import BagTopic, described
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.errors import HumansimError

#: Messages become a chunk when their total size reaches this, bytes.
_CHUNK_BYTES = 4 << 20
#: After this time, seconds, messages become a chunk even if they are few. A killed recorder loses no more
#: than this.
_CHUNK_SECONDS = 0.5


@dataclass(frozen=True)
class _FrameEnd:
    """Item of the queue: all messages of a frame come before this item. ``stamp``: stamp of the frame."""

    stamp: int


_Item: TypeAlias = BagTopic | BagMessage | _FrameEnd


class BagThread:
    """A queue of messages, limited in bytes, and a thread that writes the messages into a bag.

    Args:
        open_bag: Function that opens the bag. Only the thread calls it, and uses and closes the bag.
        max_bytes: Most bytes of messages in the queue. A longer message is accepted when the queue is empty.
        compression: Compression of the chunks.
        on_written: Called in the thread with the stamp of a frame, after the messages of the frame have been
            written. If None, messages do not belong to frames, and are written after half a second.

    Attributes:
        error: The error that has ended the thread. None while it writes.
        written: Number of messages in the file.
        written_bytes: Total size of these messages, bytes.

    Raises:
        HumansimError: The bag cannot be opened.
    """

    def __init__(
        self,
        open_bag: Callable[[], BagWriter],
        max_bytes: int,
        compression: Compression = "none",
        on_written: Callable[[int], object] | None = None,
    ) -> None:
        self._max_bytes, self._compression, self._on_written = max_bytes, compression, on_written
        self._items: deque[_Item] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._closing = False
        self.error: HumansimError | None = None
        self.written = self.written_bytes = 0
        opened: Future[Sequence[BagTopic]] = Future()
        self._thread = threading.Thread(target=self._run, args=(open_bag, opened), name="bag", daemon=True)
        self._thread.start()
        self._topics = {topic.name: number for number, topic in enumerate(opened.result())}

    def add_topic(self, topic: BagTopic) -> int:
        """Add a topic, unless the bag has it already. Returns the index of the topic for messages."""
        if topic.name not in self._topics:
            self._topics[topic.name] = len(self._topics)
            self._put(topic)
        return self._topics[topic.name]

    def add(self, message: BagMessage, wait: bool = False) -> bool:
        """Queue a message. Returns whether there was space for it. ``wait``: whether to wait for space while
        the thread writes."""
        size = len(message.data)
        with self._changed:
            while self._bytes and self._bytes + size > self._max_bytes and not self.error:
                if not wait:
                    return False
                self._changed.wait()
            if self.error:
                return False
            self._bytes += size
            self._items.append(message)
            self._changed.notify_all()
        return True

    def end_frame(self, stamp: int) -> None:
        """Let the thread write everything in the queue now, as a group of chunks that stays in one file. Then
        ``on_written`` is called."""
        self._put(_FrameEnd(stamp))

    def close(self) -> None:
        """Write everything in the queue and finish the bag. If that fails, ``error`` is set."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join()

    def _put(self, item: _Item) -> None:
        with self._changed:
            self._items.append(item)
            self._changed.notify_all()

    def _run(self, open_bag: Callable[[], BagWriter], opened: Future[Sequence[BagTopic]]) -> None:
        try:
            writer = open_bag()
        except BaseException as error:
            opened.set_exception(error)
            return
        opened.set_result(writer.topics)
        try:
            self._write_all(writer)
            writer.close()
        except Exception as error:  # whatever the error is, the node must not wait for this thread for ever
            with suppress(HumansimError, OSError):
                writer.close()
            self._fail(_as_error(error))

    def _fail(self, error: HumansimError) -> None:
        with self._changed:
            self.error = error
            self._items.clear()
            self._bytes = 0
            self._changed.notify_all()

    def _write_all(self, writer: BagWriter) -> None:
        in_frames = self._on_written is not None
        messages: list[BagMessage] = []
        size, due = 0, math.inf
        while True:
            item = self._next(due)
            if isinstance(item, BagTopic):
                writer.add_topic(described(item))
                continue
            message = item if isinstance(item, BagMessage) else None
            if messages and (message is None or size + len(message.data) > _CHUNK_BYTES):
                chunk = encode_chunk(messages, self._compression)
                writer.append(chunk, ends_group=not (in_frames and message))
                self._release(len(messages), size)
                messages, size, due = [], 0, math.inf
            if message is not None:
                if not (messages or in_frames):
                    due = time.monotonic() + _CHUNK_SECONDS
                messages.append(message)
                size += len(message.data)
            elif isinstance(item, _FrameEnd) and self._on_written is not None:
                self._on_written(item.stamp)
            elif self._closing and not self._items:
                return

    def _next(self, due: float) -> _Item | None:
        """Wait for the next item of the queue. None after the monotonic time ``due``, and at the end."""
        with self._changed:
            while time.monotonic() < due:
                if self._items:
                    return self._items.popleft()
                if self._closing:
                    break
                self._changed.wait(None if math.isinf(due) else max(0.0, due - time.monotonic()))
            return None

    def _release(self, number: int, size: int) -> None:
        """Note that messages have been written, so that the queue has space for others."""
        with self._changed:
            self.written += number
            self.written_bytes += size
            self._bytes -= size
            self._changed.notify_all()


def _as_error(error: Exception) -> HumansimError:
    if isinstance(error, HumansimError):
        return error
    if isinstance(error, OSError):
        return HumansimError(f"the bag cannot be written: {error.strerror or error}")
    return HumansimError(f"the bag cannot be written ({type(error).__name__}: {error})")
