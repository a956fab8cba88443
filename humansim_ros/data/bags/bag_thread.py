"""Write messages into a bag in a thread, so that a slow disk does not delay the node that receives them."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from typing import TypeAlias

from humansim_ros.data.bags.topics import BagMessage, BagTopic
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.errors import HumansimError

#: After this time, seconds, messages are in the file, even if they are few. A killed recorder loses no more.
_FLUSH_SECONDS = 0.5
#: A message, a new topic, the stamp of a complete frame, or the end (None).
_Item: TypeAlias = BagMessage | BagTopic | int | None


class BagThread:
    """A queue of messages, limited in bytes, and a thread that writes the messages into a bag.

    Args:
        open_bag: Function that opens the bag. Only the thread calls it, and uses and closes the bag.
        max_bytes: Most bytes of messages in the queue. A longer message is accepted when the queue is empty.
        on_written: Called in the thread with the stamp of a frame, after the messages of the frame have been
            written. If None, messages do not belong to frames.

    Attributes:
        error: The error that has ended the thread. None while it writes.
        written: Number of messages that have been written.
        written_bytes: Total size of these messages, bytes.

    Raises:
        HumansimError: The bag cannot be opened.
    """

    def __init__(
        self,
        open_bag: Callable[[], BagWriter],
        max_bytes: int,
        on_written: Callable[[int], object] | None = None,
    ) -> None:
        self._max_bytes, self._on_written = max_bytes, on_written
        self._items: deque[_Item] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
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
            self._put(message)
        return True

    def end_frame(self, stamp: int) -> None:
        """Let the thread write everything in the queue now. Then ``on_written`` is called."""
        self._put(stamp)

    def close(self) -> None:
        """Write everything in the queue and finish the bag. If that fails, ``error`` is set."""
        self._put(None)
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
        due: float | None = None  # when the messages so far must be in the file
        while True:
            with self._changed:
                while not self._items and (due is None or time.monotonic() < due):
                    self._changed.wait(None if due is None else max(0.0, due - time.monotonic()))
                is_late = not self._items
                item = None if is_late else self._items.popleft()
            if isinstance(item, BagMessage):
                writer.write([item])
                self._release(len(item.data))
                due = due or time.monotonic() + _FLUSH_SECONDS
            elif isinstance(item, BagTopic):
                writer.add_topic(item)
            elif is_late or item is not None:
                writer.flush()
                due = None
                if item is not None and self._on_written is not None:
                    self._on_written(item)
            else:
                return

    def _release(self, size: int) -> None:
        """Note that a message has been written, so that the queue has space for others."""
        with self._changed:
            self.written += 1
            self.written_bytes += size
            self._bytes -= size
            self._changed.notify_all()


def _as_error(error: Exception) -> HumansimError:
    if isinstance(error, HumansimError):
        return error
    if isinstance(error, OSError):
        return HumansimError(f"the bag cannot be written: {error.strerror or error}")
    return HumansimError(f"the bag cannot be written ({type(error).__name__}: {error})")
