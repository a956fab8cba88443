"""The ``humansim`` command in the process of a test: a process of its own takes a second to start."""

from __future__ import annotations

import io
import warnings
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass

from humansim_ros.cli.main import main


@dataclass(frozen=True)
class Done:
    """Exit code and output of a command, named as a finished process has them."""

    returncode: int
    stdout: str
    stderr: str


def humansim(*words: object) -> Done:
    """Run a command in this process, such as ``humansim("check", path)``."""
    out, err = io.StringIO(), io.StringIO()
    with warnings.catch_warnings(), redirect_stdout(out), redirect_stderr(err):
        try:
            code = main([str(word) for word in words])
        except SystemExit as end:  # of completions
            code = int(end.code or 0)
    return Done(code, out.getvalue(), err.getvalue())
