"""The ``humansim`` command in the process of a test: a process of its own takes a second to start."""

from __future__ import annotations

import io
import resource
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass

from humansim_ros.cli.main import main


@dataclass(frozen=True)
class Done:
    """Exit code and output of a command, named as a finished process has them."""

    returncode: int
    stdout: str
    stderr: str


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Limit the size of files that this process writes; the system reports it as it does a full disk.

    Python would cut the bytecode of modules that it imports meanwhile, and not notice it: it writes none.
    """
    before, writes_none = resource.getrlimit(resource.RLIMIT_FSIZE), sys.dont_write_bytecode
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    sys.dont_write_bytecode = True
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        sys.dont_write_bytecode = writes_none


def humansim(*words: object) -> Done:
    """Run a command in this process, such as ``humansim("check", path)``."""
    out, err = io.StringIO(), io.StringIO()
    with warnings.catch_warnings(), redirect_stdout(out), redirect_stderr(err):
        try:
            code = main([str(word) for word in words])
        except SystemExit as end:  # of completions
            code = int(end.code or 0)
    return Done(code, out.getvalue(), err.getvalue())
