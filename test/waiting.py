"""Waiting for conditions, with generous limits: a test must pass on a loaded machine, and must not hang."""

from __future__ import annotations

import os
import time
from collections.abc import Callable

#: Seconds until a test gives up waiting. It is never slept: tests go on as soon as their condition is true.
#: HUMANSIM_TEST_PATIENCE multiplies it for machines that are slower still.
PATIENCE = 180.0 * float(os.environ.get("HUMANSIM_TEST_PATIENCE") or 1)


def wait_until(
    condition: Callable[[], object],
    limit: float = PATIENCE,
    step: Callable[[], object] = lambda: time.sleep(0.05),
) -> bool:
    """Call ``step`` until ``condition`` is true; False if it is not after ``limit`` seconds."""
    end = time.monotonic() + limit
    while not condition():
        if time.monotonic() > end:
            return False
        step()
    return True
