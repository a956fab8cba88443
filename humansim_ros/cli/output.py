"""Output of the commands: text, JSON, warnings, progress, and errors of writing files."""

from __future__ import annotations

import io
import json
import os
import sys
import time
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from humansim_ros.errors import HumansimError, escaped
from humansim_ros.ros.processes import Stopped

if TYPE_CHECKING:
    from humansim_ros.data.engine import WorkPlan, WorkProgress


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
    try:
        if output.is_dir():
            raise HumansimError("this is a folder: give a file in it", path=output)
        if not output.resolve().parent.is_dir():
            raise HumansimError("its folder does not exist", path=output)
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


class WorkDisplay:
    """Shows the progress of a recording or an export: a bar on a terminal, or else a line every five seconds.

    Use it in a ``with`` block, and pass :meth:`show` as ``on_state``.

    Attributes:
        plan, progress: Last plan and progress. None before the work has begun.
    """

    def __init__(self, title: str, output: str) -> None:
        self._title, self._output = title, output
        self.plan: WorkPlan | None = None
        self.progress: WorkProgress | None = None
        self._bar: Any = None
        self._last = time.monotonic()

    def __enter__(self) -> WorkDisplay:
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        if self._bar is not None:
            self._bar.stop()
        if isinstance(error, Stopped):
            print_text(f"stopped; {self._output}: {self._kept()}; the same command with --resume continues")

    def _kept(self) -> str:
        if self.progress is None or self.plan is None:
            return "nothing is finished"
        return f"{self.progress.kept} of {self.progress.total} {self.plan.items} are finished"

    def show(self, plan: WorkPlan, progress: WorkProgress) -> None:
        """Show a state of the work."""
        if self.plan is None and sys.stderr.isatty():
            self._start_bar(plan)
        self.plan, self.progress = plan, progress
        rate = f"{rate_text(plan, progress)}, {time_left(progress)}"
        if self._bar is not None:
            self._bar.update(self._task, total=progress.total, completed=progress.done, rate=rate)
        elif time.monotonic() - self._last >= _LINE_EVERY:
            self._last = time.monotonic()
            text = f"{progress.done} of {progress.total} {plan.items}, {rate}"
            print(text, file=sys.stderr, flush=True)

    def _start_bar(self, plan: WorkPlan) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn
        from rich.progress import Progress as Bar

        self._bar = Bar(
            TextColumn(self._title),
            BarColumn(),
            TextColumn(f"{{task.completed}}/{{task.total}} {plan.items}"),
            TextColumn("{task.fields[rate]}"),
            console=Console(stderr=True),
        )
        self._bar.start()
        self._task = self._bar.add_task("", total=None, rate="starting")

    def summary(self) -> str:
        """Text after the work: number of items, rate, and the processor time of each step."""
        plan, progress = self.plan, self.progress
        assert plan is not None and progress is not None
        if not progress.new:
            return f"{self._output}: all {progress.total} {plan.items} are written already"
        units = progress.new * max(plan.views, 1)
        unit = "camera-frame" if plan.views else plan.items.removesuffix("s")
        costs = (f"{step} {1e3 * seconds / units:.2f}" for step, seconds in progress.costs.items())
        return (
            f"wrote {self._output}: {progress.done} {plan.items}, {rate_text(plan, progress)}, "
            f"{progress.size / units:.0f} bytes per {unit}\n"
            f"processor time in ms per {unit}: {', '.join(costs)}"
        )


def time_left(progress: WorkProgress) -> str:
    """Text with the time left, from the rate of this run, since an earlier run had another rate."""
    if not progress.rate:  # no task of a cluster has ended yet
        return "unknown time left"
    seconds = (progress.total - progress.done) / progress.rate
    return f"{timedelta(seconds=round(seconds))} left"


def rate_text(plan: WorkPlan, progress: WorkProgress) -> str:
    """Text with the rate of the work, in camera-frames or items per second."""
    megabytes = progress.size / 1e6 / progress.seconds if progress.seconds else 0.0
    rate, unit = progress.rate, plan.items
    if plan.views:
        rate, unit = plan.views * rate, "camera-frames"
    number = f"{rate:.0f}" if rate >= 10 else f"{rate:.2g}"
    return f"{number} {unit}/s, {megabytes:.0f} MB/s"
