"""What the commands print and write, and how they say that they cannot."""

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


def check_folder(output: Path) -> None:
    """Said before the work, not after it."""
    with written(output):
        if output.is_dir():
            raise HumansimError("this is a folder: name a file in it", path=output)
        if not output.resolve().parent.is_dir():
            raise HumansimError("there is no such folder to write to", path=output)


@contextmanager
def written(output: Path) -> Iterator[None]:
    """Turns what writing a file raises into an error for people."""
    try:
        yield
    except OSError as reason:
        raise HumansimError(f"cannot be written: {reason.strerror or reason}", path=output) from None


def warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)


def to_json(data: Any) -> str:
    try:
        return json.dumps(data, allow_nan=False)
    except ValueError:
        raise HumansimError("there are numbers that are too large to work with") from None


def say(text: str) -> None:
    """To standard output, whatever its encoding; a reader that has seen enough (`| head`) is no error."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        print(text, flush=True)
    except OSError as reason:
        # what is still in the buffer must not be tried again when Python ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(reason, BrokenPipeError):
            raise HumansimError(f"cannot write to standard output: {reason.strerror}") from None


@contextmanager
def progress_bar(frames: Iterable[Any], count: int) -> Iterator[Iterable[Any]]:
    """A bar on a terminal, nothing elsewhere."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        yield progress.track(frames, total=count, description="drawing")
