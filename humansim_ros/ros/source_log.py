"""Log of the joint source of a human: its changes, and its silence."""

from __future__ import annotations

from collections.abc import Callable

#: Seconds between two lines about changes of the source.
_CHANGES_EVERY = 10.0
#: Seconds without a message after which a live source is silent, before its first message and after it.
_SILENT_AT_START, _SILENT_AFTER = 3.0, 2.0


class SourceLog:
    """Writes what a user of live motion capture has to know, each thing once.

    Args:
        log: Writes a line.
        human: Name of the human.
        topic: Topic of its motion.
    """

    def __init__(self, log: Callable[[str], None], human: str, topic: str) -> None:
        self._log, self._human, self._topic = log, human, topic
        self._number = self._changes = 0
        self._next_change = 0.0
        self._since: float | None = None
        self._heard = self._silent = False

    def add_source(self, number: int, text: str, now: float) -> bool:
        """Log a change of the source: at once, and then at most every ten seconds.

        Args:
            number: Number of the source; 0 for that of the scene.
            text: Description of the source.
            now: Monotonic seconds.

        Returns:
            Whether a line was written.
        """
        if number != self._number:
            self._number = number
            self._changes += 1
        if not self._changes or now < self._next_change:
            return False
        often = f"; it changed {self._changes} times: is there only one sender?" if self._changes > 1 else ""
        self._log(f"joint source: {text or 'the motion of the scene'}{often}")
        self._changes, self._next_change = 0, now + _CHANGES_EVERY
        return True

    def add_frame(self, has_message: bool, now: float) -> bool:
        """Record a frame of a live human, and log when its source is silent and when it is back.

        ``has_message``: whether a message has arrived since the last frame. ``now``: monotonic seconds.

        Returns:
            Whether the source is silent.
        """
        if self._since is None or has_message:
            if self._silent and has_message:
                self._log(f"motion arrives on {self._topic}: {self._human} follows it")
            self._since, self._heard, self._silent = now, self._heard or has_message, False
            return False
        if self._silent or now - self._since < (_SILENT_AFTER if self._heard else _SILENT_AT_START):
            return self._silent
        self._silent = True
        if self._heard:
            self._log(f"no motion arrives on {self._topic}: {self._human} keeps its last pose")
        else:
            self._log(
                f"nobody publishes {self._topic} yet: {self._human} stands at rest. An example of a sender: "
                f"python examples/live_mocap.py walk {self._human}"
            )
        return True

    def forget_frames(self) -> None:
        """Forget the live frames: the motion player moves the human again."""
        self._since, self._heard, self._silent = None, False, False
