"""Waiting for conditions, with generous limits: a test passes on a loaded machine, and does not hang."""

from __future__ import annotations

import os
import time
from collections.abc import Callable


def patience(seconds: float) -> float:
    """Seconds until a test gives up waiting: HUMANSIM_TEST_PATIENCE multiplies them for slow machines."""
    return seconds * float(os.environ.get("HUMANSIM_TEST_PATIENCE") or 1)


def wait_until(
    condition: Callable[[], object], limit: float, step: Callable[[], object] = lambda: time.sleep(0.05)
) -> bool:
    """Call ``step`` until ``condition`` is true; False if it is not after ``limit`` seconds."""
    end = time.monotonic() + limit
    while not condition():
        if time.monotonic() > end:
            return False
        step()
    return True
