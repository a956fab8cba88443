"""Progress of recordings and exports: a bar on a terminal, lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from humansim_ros.record.progress import FrameProgress

#: Seconds between lines of progress where there is no terminal.
_LINE_EVERY = 5.0


@contextmanager
def frame_progress(
    title: str, cameras: int, unit: str = "frames"
) -> Iterator[Callable[[FrameProgress], None]]:
    """Show progress: a bar on a terminal, else a line every five seconds.

    ``title``: before the bar. ``cameras``: camera-frames for each ``unit``.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(cameras, unit)
        return
    columns = (
        TextColumn(title),
        BarColumn(),
        TextColumn(f"{{task.completed}}/{{task.total}} {unit}"),
        TextColumn("{task.fields[rate]}"),
    )
    with Progress(*columns, console=console) as bar:
        task = bar.add_task("", total=None, rate="starting")

        def show(progress: FrameProgress) -> None:
            rate = f"{rate_text(progress, cameras)}, {_left(progress)}"
            bar.update(task, total=progress.frames, completed=progress.done, rate=rate)

        yield show


def _lines(cameras: int, unit: str) -> Callable[[FrameProgress], None]:
    """Function that prints a line every five seconds."""
    last = time.monotonic()

    def show(progress: FrameProgress) -> None:
        nonlocal last
        if time.monotonic() - last >= _LINE_EVERY:
            last = time.monotonic()
            done = f"{progress.done} of {progress.frames} {unit}"
            text = f"{done}, {rate_text(progress, cameras)}, {_left(progress)}"
            print(text, file=sys.stderr, flush=True)

    return show


def _left(progress: FrameProgress) -> str:
    """Time left in words, from the rate of this process: a continued recording had another one."""
    if not progress.rate:  # no task of a cluster has ended
        return "unknown time left"
    seconds = (progress.frames - progress.done) / progress.rate
    return f"{timedelta(seconds=round(seconds))} left"


def rate_text(progress: FrameProgress, cameras: int) -> str:
    """Rate in words. ``cameras``: camera-frames for each frame; 0: count frames."""
    megabytes = progress.size / 1e6 / progress.seconds if progress.seconds else 0.0
    if not cameras:
        return f"{progress.rate:.0f} frames/s, {megabytes:.0f} MB/s"
    return f"{cameras * progress.rate:.0f} camera-frames/s, {megabytes:.0f} MB/s"
