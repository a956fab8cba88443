"""Waiting for conditions, with generous limits: a test must pass on a loaded machine, and must not hang."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from humansim_ros.testing import support as waiting
from humansim_ros.testing.support import patience

#: Seconds until a test gives up waiting. It is never slept: tests go on as soon as their condition is true.
PATIENCE = patience(180.0)


def wait_until(
    condition: Callable[[], object],
    limit: float = PATIENCE,
    step: Callable[[], object] = lambda: time.sleep(0.05),
) -> bool:
    """Call ``step`` until ``condition`` is true; False if it is not after ``limit`` seconds."""
    return waiting.wait_until(condition, limit, step)


def children(parent: int) -> dict[int, str]:
    """Child processes of a process, with their command lines."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1]) == parent:
                found[int(entry.name)] = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
    return found


def end_process(process: subprocess.Popen[Any]) -> None:
    """Ask a process to end; kill it if it does not: rclpy sometimes misses SIGTERM."""
    process.terminate()
    try:
        process.wait(30)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
