"""Output of the commands: text, JSON, warnings, progress, and errors of writing files."""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
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
    """Convert errors of writing a file to HumansimError with the file."""
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
    """Print to standard output in any encoding. A closed pipe (``| head``) is not an error."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        print(text, flush=True)
    except OSError as reason:
        # Python must not try to write the rest of the buffer again when it ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(reason, BrokenPipeError):
            raise HumansimError(f"cannot write to standard output: {reason.strerror}") from None


@contextmanager
def progress_bar(frames: Iterable[Any], count: int) -> Iterator[Iterable[Any]]:
    """Show a progress bar on a terminal, and nothing elsewhere."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        yield progress.track(frames, total=count, description="drawing")
