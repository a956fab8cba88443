"""The errors this package raises on bad input: one family, made for the person who reads them.

Every message says what is wrong, where (file, line or key), and what to do. The command line prints them
without a traceback and exits with code 2.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class HumansimError(Exception):
    """Base of every error that bad input, a bad setting or a missing part of the system causes.

    ``path``, ``line`` and ``key`` say where; they stand in front of the message when given.
    """

    def __init__(
        self,
        message: str,
        *,
        path: str | os.PathLike[str] | None = None,
        line: int | None = None,
        key: str | None = None,
    ) -> None:
        self.message = message
        self.path = None if path is None else os.fspath(path)
        self.line = line
        self.key = key
        super().__init__(message)

    def __str__(self) -> str:
        where = "".join(
            (
                self.path or "",
                f":{self.line}" if self.line is not None else "",
            )
        )
        parts = [part for part in (where, self.key, self.message) if part]
        return ": ".join(parts)

    def within(self, section: str) -> HumansimError:
        """The same error seen from a file that has its key in ``section``, or names its file there."""
        if self.path is not None:
            return type(self)(str(self), key=section)
        return type(self)(self.message, key=f"{section}.{self.key}" if self.key else section)


@contextmanager
def in_section(section: str) -> Iterator[None]:
    """Put ``section`` before the keys of errors; an error in another file becomes an error of that key.

    The code that has read the file adds path and line. ``__cause__`` is the error in the other file.
    """
    try:
        yield
    except HumansimError as error:
        raise error.within(section) from (error.__cause__ if error.path is None else error)


class ResourceError(HumansimError):
    """A file that belongs to this package (configuration, asset) cannot be found."""


class MotionError(HumansimError):
    """A motion file cannot be read, or its joints cannot be understood."""


class MeshError(HumansimError):
    """A mesh, skeleton or human file cannot be read or used."""


class CameraError(HumansimError):
    """A camera's calibration cannot be used."""


class SceneError(HumansimError):
    """A scene file is wrong."""


class RenderError(HumansimError):
    """Nothing can be rendered: no OpenGL, or a request beyond its limits."""


class RosError(HumansimError):
    """ROS 2 is not installed or cannot be reached."""


def warn_about(path: str | os.PathLike[str], message: str) -> None:
    """Warn of something odd in a file that can be used all the same."""
    warnings.warn(f"{os.fspath(path)}: {message}", HumansimWarning, stacklevel=3)


class HumansimWarning(UserWarning):
    """Input that was usable but not as it should be; the message says what was assumed."""


def show_warnings() -> None:
    """Print our warnings as lines for people, each once, and no others: what a program does at its start."""
    told = set[str]()

    def tell(message: Any, category: type[Warning], filename: str, lineno: int, *_: Any) -> None:
        if issubclass(category, HumansimWarning) and str(message) not in told:
            told.add(str(message))  # (the filter "once" forgets whenever filters change)
            print(f"warning: {message}", file=sys.stderr)

    warnings.showwarning = tell  # type: ignore[assignment]  # a narrower one is enough here
