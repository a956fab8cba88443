"""What the calibration formats share: a camera as a file says it, places in files, numbers read and written.

A format reads text into :class:`RawCamera`, in the file's own unit and axes, and writes cameras that are
already in them; calibration.py does the rest, once for all.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count, islice
from typing import Any

import numpy as np
import yaml

from humansim_ros.camera.camera import Camera
from humansim_ros.errors import CameraError
from humansim_ros.io.yaml import line_of
from humansim_ros.types import Array

Key = str | int

#: Larger numbers are of no camera, and their squares and cubes overflow.
LARGEST = 1e15
#: Characters of a line: one of COLMAP's has a hundred thousand points of an image.
_LONGEST_LINE = 4 << 20
#: Rigs are smaller; a file with more is not what it seems.
MAX_CAMERAS = 10_000
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[+-]?\.?(?:nan|inf|infinity)", re.IGNORECASE)
#: Suffixes of the images that some formats name their cameras by.
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")


@dataclass(frozen=True)
class FilePosition:
    """Where in a file something is said."""

    key: str | None = None
    line: int | None = None
    #: where it is not the file that was asked for
    path: str | None = None


@dataclass(frozen=True)
class RawCamera:
    """One camera as a file says it: lengths in the file's unit, the world in the file's axes.

    ``K`` (3, 3), ``R`` (3, 3), ``t`` (3,): x_cam = R x + t; or ``center`` (3,) in place of t. ``places``:
    where each of these is said, and, under "", where the camera begins.
    """

    K: Array
    R: Array = field(default_factory=lambda: np.eye(3))
    t: Array = field(default_factory=lambda: np.zeros(3))
    center: Array | None = None
    size: tuple[int, int] | None = None
    distortion: tuple[float, ...] = ()
    model: str | None = None
    rectification: Array | None = None
    rectified: Array | None = None
    places: Mapping[str, FilePosition] = field(default_factory=dict)


@dataclass(frozen=True)
class CalibrationSource:
    """A calibration file: its text, and, for YAML, JSON and XML, what is in it.

    Keys are paths into ``document``. What is wrong raises CameraError with file, key, and line where known.
    """

    path: str
    text: str
    document: Any = None
    tree: yaml.Node | None = None

    def place(self, *keys: Key) -> FilePosition:
        return FilePosition(".".join(map(str, keys)) or None, line_of(self.tree, keys))

    def error(self, message: str, *keys: Key, line: int | None = None) -> CameraError:
        place = self.place(*keys)
        return CameraError(message, path=self.path, line=line or place.line, key=place.key)

    def get(self, *keys: Key) -> Any:
        """The value at a key path; None where there is none."""
        value = self.document
        for key in keys:
            if isinstance(value, Mapping):
                value = value.get(key)
            elif isinstance(value, list) and isinstance(key, int):
                value = value[key] if key < len(value) else None
            else:
                return None
        return value

    def need(self, *keys: Key) -> Any:
        value = self.get(*keys)
        if value is None:
            raise self.error("is missing", *keys)
        return value

    def mapping(self, *keys: Key) -> Mapping[Any, Any]:
        value = self.need(*keys)
        if not isinstance(value, Mapping):
            raise self.error("needs keys and values", *keys)
        return value

    def numbers(self, shape: tuple[int, ...], *keys: Key) -> Array:
        """Exactly as many numbers as ``shape`` has, row by row, however they are nested."""
        values = self.some_numbers(*keys)
        if len(values) != np.prod(shape):
            size = " x ".join(map(str, shape))
            raise self.error(f"needs {size} numbers, not {len(values)}", *keys)
        return values.reshape(shape)

    def some_numbers(self, *keys: Key, most: int = 1000) -> Array:
        """All numbers (N,) of a value, row by row."""
        try:
            return np.array([to_number(v) for v in _flat(self.need(*keys), most)], dtype=float)
        except ValueError as reason:
            raise self.error(str(reason), *keys) from None

    def size(self, width: Sequence[Key], height: Sequence[Key]) -> tuple[int, int]:
        return self.whole(*width), self.whole(*height)

    def whole(self, *keys: Key) -> int:
        """A positive whole number."""
        value = float(self.numbers((), *keys))
        if value != int(value) or value <= 0:
            raise self.error(f"needs a whole number above zero, not {value:g}", *keys)
        return int(value)

    def row(self, words: Iterable[str], line: int, key: str | None = None) -> list[float]:
        """Numbers of a line of a text file."""
        try:
            return [to_number(word) for word in words]
        except ValueError as reason:
            raise CameraError(str(reason), path=self.path, line=line, key=key) from None

    def add(
        self, cameras: dict[str, RawCamera], name: str, camera: RawCamera, *keys: Key, line: int | None = None
    ) -> None:
        """Put a camera with the others, under a name of its own."""
        if name in cameras:
            raise self.error(f"there are two cameras of the name {name!r}", *keys, line=line)
        if len(cameras) >= MAX_CAMERAS:
            raise self.error(f"there are more than {MAX_CAMERAS} cameras", *keys, line=line)
        cameras[name] = camera

    def lines(self) -> Iterator[tuple[int, str]]:
        """Number (from 1) and text of each line that is neither empty nor a comment."""
        return ((n, line) for n, line in self.all_lines() if line and line[0] not in "#;")

    @cached_property
    def head(self) -> list[str]:
        """The first three of :meth:`lines`, to tell forms by."""
        return [line for _, line in islice(self.lines(), 3)]

    def all_lines(self) -> Iterator[tuple[int, str]]:
        """Number (from 1) and text, without blanks at its ends, of each line, one after the other."""
        start = 0
        for number in count(1):
            end = self.text.find("\n", start)
            line = self.text[start : end if end >= 0 else None].strip()
            if len(line) > _LONGEST_LINE:
                raise CameraError("this line is too long to be of a calibration", path=self.path, line=number)
            yield number, line
            if end < 0:
                return
            start = end + 1


@dataclass(frozen=True)
class CalibrationFormat:
    """A kind of calibration file.

    ``container``: text, yaml, json or xml. ``matches`` tells it from others of that container.
    ``write`` gives the text of each file by its name; a form of one file gives it under "". ``unit``: metres
    per unit of the file; ``up``: the axis of its world that points up. ``lenses``: models that it can hold,
    and how many of their coefficients. ``sizes``: what its images usually are, where it does not say.
    """

    name: str
    title: str
    suffix: str
    container: str
    matches: Callable[[CalibrationSource], bool]
    read: Callable[[CalibrationSource], dict[str, RawCamera]]
    write: Callable[[Mapping[str, Camera]], dict[str, str]]
    several: bool = True
    unit: float = 1.0
    up: str = "z"
    holds_size: bool = True
    holds_pose: bool = True
    holds_skew: bool = True
    holds_rectified: bool = False
    lenses: Mapping[str, int] = field(default_factory=dict)
    sizes: tuple[tuple[int, int], ...] = ()


def to_number(value: Any) -> float:
    """A finite number; also of text, as YAML 1.1 takes 1e-5 for. Raises ValueError with the reason."""
    if isinstance(value, str):
        word = value.strip()
        if _NUMBER.fullmatch(word) is None:
            finite = _NOT_FINITE.fullmatch(word) is None
            raise ValueError(
                f"{_short(word)!r} is not a number" if finite else "a number is not finite (NaN or infinity)"
            )
        value = float(word)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{_short(value)!r} is not a number")
    try:
        number = float(value)
    except OverflowError:
        number = np.inf
    if not np.isfinite(number):
        raise ValueError("a number is not finite (NaN or infinity)")
    if abs(number) > LARGEST:
        raise ValueError(f"{number:g} is too large to be of a camera")
    return number


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else type(value).__name__
    return text if len(text) <= 30 else text[:27] + "..."


def _flat(value: Any, most: int, depth: int = 4) -> list[Any]:
    """What is in nested lists; never more than ``most``, so that a file cannot promise more than it holds."""
    if not isinstance(value, (list, tuple)):
        return [value]
    flat: list[Any] = []
    if depth == 0:
        raise ValueError("the lists are nested too deeply")
    for item in value:
        flat += _flat(item, most, depth - 1)
        if len(flat) > most:
            raise ValueError(f"has more than {most} numbers")
    return flat


def number(value: float) -> str:
    """All digits that it takes to read the same number again."""
    return repr(float(value) + 0.0)  # no -0.0


def row(values: Iterable[float], between: str = " ") -> str:
    return between.join(number(v) for v in values)


def nested(matrix: Array) -> list[Any]:
    """Lists of a matrix, as JSON has them, without -0.0."""
    return (np.asarray(matrix, dtype=float) + 0.0).tolist()


def without_suffix(name: str) -> str:
    """The name of a camera whose image a file names."""
    for suffix in _PICTURES:
        if name.lower().endswith(suffix) and len(name) > len(suffix):
            return name[: -len(suffix)]
    return name


def check_words(names: Iterable[str]) -> None:
    """That names can stand in columns split by blanks. Raises CameraError."""
    for name in names:
        if not name or not name.isprintable() or any(c.isspace() for c in name) or name[0] in "#;%/":
            raise CameraError(
                "needs a name without blanks, that begins with no # ; % or / in this form", key=name
            )


def picture_names(cameras: Iterable[str]) -> dict[str, str]:
    """Image names for forms that name cameras by their images, in columns split by blanks."""
    names = list(cameras)
    check_words(names)
    return {name: f"{name}.png" for name in names}
