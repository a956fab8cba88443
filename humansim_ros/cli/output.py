"""Output of the commands: text, JSON, warnings, progress, and errors of writing files."""

from __future__ import annotations

import io
import json
import os
import sys
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from humansim_ros.errors import HumansimError


def check_output(output: Path) -> None:
    """Raise HumansimError if a file cannot be written; called before long work, not after it."""
    with report_write_errors(output):
        if output.is_dir():
            raise HumansimError("this is a folder: give a file in it", path=output)
        if not output.resolve().parent.is_dir():
            raise HumansimError("its folder does not exist", path=output)


@contextmanager
def report_write_errors(output: Path) -> Iterator[None]:
    """Convert errors of the system about an output to HumansimError with its path."""
    try:
        yield
    except OSError as reason:
        raise HumansimError(f"cannot be written: {reason.strerror or reason}", path=output) from None


def print_warning(text: str) -> None:
    """Print a warning to standard error."""
    print(f"warning: {text}", file=sys.stderr)


def to_json(data: Any) -> str:
    """JSON text without NaN and infinity, which JSON cannot represent."""
    try:
        return json.dumps(data, allow_nan=False)
    except ValueError:
        raise HumansimError("a number is too large or not finite") from None


def print_text(text: str) -> None:
    """Print to standard output in any encoding. A closed pipe (``| head``) is not an error.

    Raises:
        HumansimError: Standard output cannot be written to, such as a file on a full disk.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    with _writing_output():
        print(text, flush=True)


def flush_output() -> None:
    """Write the rest of standard output; errors as of :func:`print_text`."""
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
    """Drop the rest of standard output: Python must not try to write it again when it ends."""
    if sys.stdout is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def print_error(text: str) -> None:
    """Print to standard error, if it can be written to; with the traceback if HUMANSIM_TRACEBACK is set."""
    with suppress(OSError):
        if os.environ.get("HUMANSIM_TRACEBACK"):
            traceback.print_exc()
        print(text, file=sys.stderr)


@contextmanager
def progress_bar(frames: Iterable[Any], count: int) -> Iterator[Iterable[Any]]:
    """Show a progress bar on a terminal, and nothing elsewhere."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        yield progress.track(frames, total=count, description="drawing")
