"""Waiting for conditions, with generous limits: a test must pass on a loaded machine, and must not hang."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from humansim_ros.ros.processes.stop_signals import children_of
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
    for pid in children_of(parent):
        with suppress(OSError):
            found[pid] = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    return found


def existing(pids: Iterable[int]) -> list[int]:
    """Processes that have not ended, or for which nobody has waited."""
    return [pid for pid in pids if Path(f"/proc/{pid}").exists()]


def has_ended(pid: int) -> bool:
    """Whether a process has ended, also if nobody has waited for it."""
    try:
        return ") Z " in Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return True


def end_process(process: subprocess.Popen[Any]) -> None:
    """Ask a process to end; kill it if it does not: rclpy sometimes misses SIGTERM."""
    process.terminate()
    try:
        process.wait(30)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
