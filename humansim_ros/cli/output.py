"""Output of the commands: text, JSON, warnings, progress, and errors of writing files."""

from __future__ import annotations

import io
import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from humansim_ros.errors import HumansimError, escaped
from humansim_ros.ros.processes import Stopped

if TYPE_CHECKING:
    from humansim_ros.data.engine import FrameProgress


#: By suffix of an output file: other suffixes of the same format, and name of the format in messages.
_KINDS = {
    ".png": ((), "the image is a"),
    ".npz": ((), "a human is written to a"),
    ".bvh": ((), "a motion is written to a"),
    ".yaml": ((".yml",), "this is written to a"),
}


def check_output(output: Path | None, suffix: str | None = None) -> None:
    """Raise HumansimError if a file cannot be written. Call it before long work, not after it. ``output``:
    the file; if None, nothing is written. ``suffix``: suffix that the file must have."""
    if output is None:
        return
    if suffix is not None:
        others, what = _KINDS[suffix]
        if output.suffix.lower() not in (suffix, *others):
            raise HumansimError(f"{what} {suffix} file: give it this suffix", path=output)
    with report_write_errors(output):
        if output.is_dir():
            raise HumansimError("this is a folder: give a file in it", path=output)
        if not output.resolve().parent.is_dir():
            raise HumansimError("its folder does not exist", path=output)


@contextmanager
def report_write_errors(output: Path) -> Iterator[None]:
    """Convert system errors about an output to HumansimError with the path of the output."""
    try:
        yield
    except OSError as reason:
        raise HumansimError(f"cannot be written: {reason.strerror or reason}", path=output) from None


def print_warning(text: str) -> None:
    """Print a warning to standard error."""
    print(f"warning: {escaped(text)}", file=sys.stderr)


def to_json(data: Any) -> str:
    """Convert data to JSON text. Raises HumansimError for NaN and infinity, which JSON does not have."""
    try:
        return json.dumps(data, allow_nan=False)
    except ValueError:
        raise HumansimError("a number is too large or not finite") from None


def print_text(text: str) -> None:
    """Print to standard output in any encoding. A closed pipe (``| head``) is not an error.

    Raises:
        HumansimError: Standard output cannot be written to, for example a file on a full disk.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    with _writing_output():
        print(text, flush=True)


def flush_output() -> None:
    """Write the rest of standard output. Errors are handled as in :func:`print_text`."""
    with _writing_output():
        if sys.stdout is not None:  # the caller has closed it
            sys.stdout.flush()


@contextmanager
def _writing_output() -> Iterator[None]:
    try:
        yield
    except OSError as reason:
        give_up_output()
        if not isinstance(reason, BrokenPipeError):
            raise HumansimError(f"cannot write to standard output: {reason.strerror}") from None


def give_up_output() -> None:
    """Discard the rest of standard output, so that Python does not fail on it again at exit."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def flush_errors() -> None:
    """Write or discard the rest of standard error, since Python would otherwise end with exit code 120."""
    try:
        if sys.stderr is not None:
            sys.stderr.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


def print_error(text: str) -> None:
    """Print to standard error if possible. If HUMANSIM_TRACEBACK is set, print the traceback, too."""
    with suppress(OSError):
        if os.environ.get("HUMANSIM_TRACEBACK"):
            traceback.print_exc()
        print(escaped(text), file=sys.stderr)


@contextmanager
def progress_bar(frames: Iterable[Any], count: int) -> Iterator[Iterable[Any]]:
    """Show a progress bar on a terminal; elsewhere, show nothing."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        yield progress.track(frames, total=count, description="drawing")


#: Seconds between lines of progress if there is no terminal.
_LINE_EVERY = 5.0


@contextmanager
def frame_progress(
    title: str, cameras: int, unit: str = "frames"
) -> Iterator[Callable[[FrameProgress], None]]:
    """Show progress: a bar on a terminal, or else a line every five seconds. ``title``: text before the bar.
    ``cameras``: number of camera-frames for each ``unit``."""
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
            rate = f"{rate_text(progress, cameras, unit)}, {time_left(progress)}"
            bar.update(task, total=progress.frames, completed=progress.done, rate=rate)

        yield show


def run_frames_shown(
    title: str,
    cameras: int,
    run: Callable[[Callable[[FrameProgress], None]], FrameProgress],
    interrupted: Callable[[int], str],
    unit: str = "frames",
) -> FrameProgress:
    """Run work on frames and show its progress. After a stop or the death of a worker, print how much is
    done.

    Args:
        title: Text before the bar.
        cameras: Number of camera-frames for each frame.
        run: Function that does the work. It must call its argument after each frame.
        interrupted: Function of the number of finished frames that returns the text for an interruption.
        unit: Name of what is counted.
    """
    from humansim_ros.data.engine import WorkerDiedError

    done = 0

    def show(progress: FrameProgress) -> None:
        nonlocal done
        done = progress.done
        display(progress)

    with frame_progress(title, cameras, unit) as display:
        try:
            return run(show)
        except WorkerDiedError as error:
            print_error(f"error: {error}; {interrupted(done)}")
            raise typer.Exit(1) from None
        except Stopped:
            print_text(f"stopped; {interrupted(done)}")
            raise


def costs_text(progress: FrameProgress, cameras: int, digits: int) -> str:
    """Text with the processor time of each step, in ms per camera-frame or, without cameras, per frame."""
    units = progress.new * max(cameras, 1)
    costs = (f"{step} {1e3 * seconds / units:.{digits}f}" for step, seconds in progress.costs.items())
    return f"processor time in ms per {'camera-frame' if cameras else 'frame'}: {', '.join(costs)}"


def _lines(cameras: int, unit: str) -> Callable[[FrameProgress], None]:
    """Return a function that prints a line of progress at most every five seconds."""
    last = time.monotonic()

    def show(progress: FrameProgress) -> None:
        nonlocal last
        if time.monotonic() - last >= _LINE_EVERY:
            last = time.monotonic()
            done = f"{progress.done} of {progress.frames} {unit}"
            text = f"{done}, {rate_text(progress, cameras, unit)}, {time_left(progress)}"
            print(text, file=sys.stderr, flush=True)

    return show


def time_left(progress: FrameProgress) -> str:
    """Text with the time left, from the rate of this run, since an earlier run had another rate."""
    if not progress.rate:  # no task of a cluster has ended yet
        return "unknown time left"
    seconds = (progress.frames - progress.done) / progress.rate
    return f"{timedelta(seconds=round(seconds))} left"


def rate_text(progress: FrameProgress, cameras: int, unit: str = "frames") -> str:
    """Text with the rate of the work.

    Args:
        progress: State of the work.
        cameras: Number of camera-frames for each frame. If 0, the rate is in units.
        unit: What is counted: frames, or scenes (which take seconds each).
    """
    megabytes = progress.size / 1e6 / progress.seconds if progress.seconds else 0.0
    if not cameras:
        rate = f"{progress.rate:.0f}" if unit == "frames" else f"{progress.rate:.2g}"
        return f"{rate} {unit}/s, {megabytes:.0f} MB/s"
    return f"{cameras * progress.rate:.0f} camera-frames/s, {megabytes:.0f} MB/s"
