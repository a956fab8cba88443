"""Keys that are pressed while a command runs."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def pressed_keys() -> Iterator[Callable[[], str]]:
    """Context manager with a function that returns the key pressed since its last call, or an empty text.

    It is always empty if standard input is no terminal, or the command runs in the background.
    """
    try:
        import termios
        import tty

        terminal = sys.stdin.fileno()
        if not sys.stdin.isatty() or os.tcgetpgrp(terminal) != os.getpgrp():
            raise OSError("no terminal")
        settings = termios.tcgetattr(terminal)
    except (ImportError, OSError, ValueError, AttributeError):  # no terminal
        yield lambda: ""
        return

    def key() -> str:
        ready = select.select([terminal], [], [], 0)[0]
        return os.read(terminal, 1).decode(errors="replace") if ready else ""

    try:
        tty.setcbreak(terminal)
        yield key
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, settings)
