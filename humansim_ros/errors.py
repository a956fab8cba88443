"""Exceptions and warnings of the package, and bounds of numbers from files, options and messages.

Each message says what is wrong, where (file, line or key) and what to do. The command line prints errors
without a traceback and exits with code 2.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

#: Hides the content of files in messages (a FileQuotes of files/reading/assets.py). If None, messages quote
#: files.
HIDING: ContextVar[Any] = ContextVar("HIDING", default=None)


#: Largest coordinate and size in metres, and velocity in m/s or rad/s.
MAX_COORDINATE = 1e6
#: Most frames of a run or a recording: a month at 30 Hz.
MAX_FRAMES = 100_000_000


def within_bounds(numbers: ArrayLike) -> bool:
    """Whether all numbers are finite and at most :data:`MAX_COORDINATE`."""
    import numpy as np  # not needed by the command line, which imports the limits

    return bool((np.abs(numbers) <= MAX_COORDINATE).all())  # False for NaN, too


class HumansimError(Exception):
    """Base class of errors from wrong input, wrong settings and missing parts of the system.

    ``path``, ``line`` and ``key`` give the location; the text of the error begins with them. ``exit_code``:
    exit code of a command that ends with the error.
    """

    exit_code = 2

    def __init__(
        self,
        message: str,
        *,
        path: str | os.PathLike[str] | None = None,
        line: int | None = None,
        key: str | None = None,
    ) -> None:
        self.message = _hidden(message)
        self.path = None if path is None else _hidden(os.fspath(path))
        self.line = line
        self.key = None if key is None else _hidden(key)
        super().__init__(self.message)

    def __str__(self) -> str:
        where = "".join(
            (
                self.path or "",
                f":{self.line}" if self.line is not None else "",
            )
        )
        parts = [escaped(part) for part in (where, self.key, self.message) if part]
        return ": ".join(parts)

    def within(self, section: str) -> HumansimError:
        """The same error with its key below ``section``. An error in another file gets the key
        ``section``."""
        if self.path is not None:
            return type(self)(str(self), key=section)
        return type(self)(self.message, key=f"{section}.{self.key}" if self.key else section)


@contextmanager
def in_section(section: str) -> Iterator[None]:
    """Put ``section`` before the keys of errors in the block. An error in another file gets this key.

    The code that has read the file adds path and line. ``__cause__`` is the error in the other file.
    """
    try:
        yield
    except HumansimError as error:
        raise error.within(section) from (error.__cause__ if error.path is None else error)


@contextmanager
def located(
    error: type[HumansimError] | None = None,
    path: str | os.PathLike[str] | None = None,
    line: int | None = None,
    key: str | None = None,
) -> Iterator[None]:
    """Add file, line and key to errors that are raised in the block without them.

    Args:
        error: Class of the errors. If None, each keeps its class.
        path: File, for errors without one.
        line: Line, for errors without one.
        key: Key, for errors without one.
    """
    try:
        yield
    except HumansimError as found:
        at = found.line if found.line is not None else line
        raised = (error or type(found))(found.message, path=found.path or path, line=at, key=found.key or key)
        raise raised from None


def _hidden(text: str) -> str:
    """Remove the content of files from a message, if it must not be shown."""
    quotes = HIDING.get()
    return text if quotes is None else str(quotes.hide(text))


def near_names(word: str, known: Iterable[str], least: float = 0.65) -> list[str]:
    """Names that resemble a word, the nearest first. Case is ignored. ``least``: least similarity, 0 to 1."""
    from difflib import get_close_matches  # only when something is wrong

    by_lower = {name.lower(): name for name in known}
    return [by_lower[name] for name in get_close_matches(word.lower(), by_lower, 3, least)]


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """End of a message about an unknown name: ``; did you mean 'walk'?``. Empty if no name is similar."""
    near = near_names(word, known)
    return f"; did you mean {near[0]!r}?" if near else ""


def unknown(kind: str, name: object, known: Iterable[str], owner: str = "", most: int = 50) -> str:
    """Message about a name that does not exist, with the name that resembles it and the names that exist.

    Args:
        kind: What should have the name, such as ``camera``.
        name: The name.
        known: Names that exist.
        owner: What should contain the thing with this name, such as ``the scene``.
        most: Number of known names that the message shows.

    Example:
        >>> unknown("camera", "fornt", ["front", "rear"], "the scene")
        "the scene has no camera 'fornt'; did you mean 'front'? There are front, rear"
    """
    names, word = list(known), str(name)
    shown = f"{owner} has no {kind}" if owner else f"no {kind}"
    near = did_you_mean(word, names)
    listed = f"{' There' if near else '; there'} are {some_of(names, most)}" if names else "; there is none"
    return f"{shown} {word[:255]!r}{near}{listed}"


def escaped(text: str) -> str:
    r"""Escape control characters, such as U+202E, which turns a line around. Line breaks are kept.

    Example:
        >>> print(escaped("a" + chr(0x202E) + "b"))
        a\u202eb
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


def printable(text: str, limit: int = 300) -> str:
    """Make text from outside (a file, a message) safe for a log: one line, with control characters escaped.

    ``limit``: number of characters that are kept.
    """
    kept = escaped(text[:limit]).replace("\n", "\\n")
    return kept if len(text) <= limit else f"{kept}… ({len(text)} characters)"


def some_of(texts: Iterable[object], most: int = 5, between: str = ", ", rest: str = " and {} more") -> str:
    """First texts of a list, and the number of the remaining texts, for a message.

    Args:
        texts: All texts.
        most: Number of texts that are shown.
        between: Text between two of them.
        rest: Text for the others; ``{}`` is their number.

    Example:
        >>> some_of("abcd", 2)
        'a, b and 2 more'
    """
    listed = [str(text) for text in texts]
    return between.join(listed[:most]) + (rest.format(len(listed) - most) if len(listed) > most else "")


class ResourceError(HumansimError):
    """A file of the package (configuration, asset) is missing."""


class MotionError(HumansimError):
    """A motion file cannot be read, or its joints cannot be matched to those of a human."""


class MeshError(HumansimError):
    """A mesh, skeleton or human file cannot be read or used."""


class CameraError(HumansimError):
    """A camera or its calibration cannot be used."""


class SceneError(HumansimError):
    """A scene is wrong."""


class RenderError(HumansimError):
    """Rendering is impossible: no OpenGL, or a request beyond its limits."""


class ChannelError(HumansimError, AttributeError):
    """A channel of a view (such as depth), or truth that is computed from channels, was not requested."""


class KeypointError(HumansimError, KeyError):
    """A keypoint set or a keypoint does not exist."""


class RosError(HumansimError):
    """ROS 2 is not installed or cannot be reached."""


class BagError(HumansimError):
    """A bag cannot be written or read."""


class ExportError(HumansimError):
    """A data set cannot be exported."""


class EvaluationError(HumansimError):
    """Ground truth or an estimate cannot be read, or they cannot be compared."""


class PhotographError(HumansimError):
    """Photographs, their calibration, points or masks cannot be read or used."""


class ChallengeError(HumansimError):
    """A suite of challenges, a tracker or a report is wrong."""


def warn_about(path: str | os.PathLike[str], message: str) -> None:
    """Issue a HumansimWarning about a file that is usable but doubtful."""
    warnings.warn(f"{os.fspath(path)}: {message}", HumansimWarning, stacklevel=3)


class HumansimWarning(UserWarning):
    """Input is usable but doubtful. The message says what is assumed."""

    def __init__(self, message: str) -> None:
        super().__init__(_hidden(message))


def show_warnings() -> None:
    """Print each HumansimWarning once, on one line of stderr; hide all other warnings. For programs."""
    shown = set[str]()

    def show(message: Any, category: type[Warning], filename: str, lineno: int, *_: Any) -> None:
        if issubclass(category, HumansimWarning) and str(message) not in shown:
            shown.add(str(message))  # the filter "once" is reset when filters change
            print(f"warning: {escaped(str(message))}", file=sys.stderr)

    warnings.showwarning = show  # type: ignore[assignment]  # a narrower one is enough here
