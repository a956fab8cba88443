"""Shared parts of the calibration formats: parsed files, lists of cameras, lens models, rotations, numbers.

A format reads a :class:`CalibrationFile` into :class:`RawCamera` objects in the unit and axes of the file. It
writes cameras that are already in this unit and these axes. ``cameras/formats/calibration.py`` does the
conversion.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.errors import CameraError
from humansim_ros.files.yaml import line_of
from humansim_ros.geometry import quaternion_to_matrix
from humansim_ros.types import Array, ImageSize

_Camera = TypeVar("_Camera")
Key = str | int
Keys = tuple[Key, ...]

#: Largest magnitude of a number. Cameras have smaller numbers, and the cubes of larger numbers overflow.
LARGEST = 1e15
#: Longest line in characters. A line of COLMAP may hold a hundred thousand points of an image.
_LONGEST_LINE = 4 << 20
#: Transform (4, 4) from the camera axes of OpenGL (x right, y up, z backward) to the camera axes of OpenCV.
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
#: ``OPENGL`` as a rotation (3, 3).
FLIP = OPENGL[:3, :3]
#: The length of a quaternion may differ from 1 by this.
_LENGTH_SLACK = 1e-2
#: Most cameras of a file.
MAX_CAMERAS = 10_000
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
#: End of the name of an image. Some formats name cameras after their images.
_IMAGE_SUFFIX = re.compile(r"(?<=.)\.(?:png|jpe?g|bmp|tiff?|pgm|ppm|webp)\Z", re.IGNORECASE | re.DOTALL)


@dataclass(frozen=True)
class SourceLocation:
    """Key and line of a value in a file. ``path``: the file, if the value is not in the file that is being
    read."""

    key: str | None = None
    line: int | None = None
    path: str | None = None


@dataclass(frozen=True)
class RawCamera:
    """A camera in the unit and the world axes of its file. ``K`` (3, 3), ``R`` (3, 3), ``t`` (3,): x_cam = R
    x + t. The camera may have ``center`` (3,) in place of t. R is None if the file has no extrinsics of the
    camera. ``locations``: where these values are in the file, by field; "" is the location of the camera.

    ``kind`` of R and t, as they are in the file: ``world`` (x = R X + t), ``camera`` (X = R x + t),
    ``center`` (x = R (X - t)), ``placed`` (a rotation with a position: ``camera`` is more likely than
    ``center``) or ``shelf`` (like ``center``, with a warning only if the views contradict). ``clear``:
    whether the keys leave no doubt about the kind. ``conventions.resolved`` makes all cameras ``world``.
    """

    K: Array
    R: Array | None = None
    t: Array = field(default_factory=lambda: np.zeros(3))
    center: Array | None = None
    size: ImageSize | None = None
    distortion: tuple[float, ...] = ()
    model: str | None = None
    rectification: Array | None = None
    rectified: Array | None = None
    locations: Mapping[str, SourceLocation] = field(default_factory=dict)
    kind: str = "world"
    clear: bool = True

    @property
    def rotation(self) -> Array:
        """R, or the identity if the camera has no extrinsics."""
        return np.eye(3) if self.R is None else self.R

    @property
    def position(self) -> Array:
        """Camera centre (3,) in the unit and axes of the file."""
        return -self.rotation.T @ self.t if self.center is None else self.center


@dataclass(frozen=True, eq=False)
class CalibrationFile:
    """A calibration file that is being read: its text and, except for plain text, its parsed content.

    Keys are paths into ``document``. A wrong value raises CameraError, which names the file, the key, and the
    line if it is known. ``tree``: nodes of YAML. ``key_lines``: lines of the keys of TOML. ``given_size``:
    image size that the caller states. ``syntax``: see ``CalibrationFormat``. ``renamed``: for a key of
    ``document`` that the file spells differently, its spelling in the file.
    """

    path: str
    text: str
    document: Any = None
    tree: yaml.Node | None = None
    key_lines: Mapping[tuple[str, ...], int] = field(default_factory=dict)
    given_size: ImageSize | None = None
    syntax: str = "text"
    renamed: Mapping[str, str] = field(default_factory=dict)

    def location(self, *keys: Key) -> SourceLocation:
        """Location of the value at a key path."""
        keys = tuple(self.renamed.get(str(key), key) for key in keys)
        line = line_of(self.tree, keys)
        for length in range(len(keys), 0, -1):
            line = line or self.key_lines.get(tuple(map(str, keys[:length])))
        return SourceLocation(".".join(map(str, keys)) or None, line)

    def error(self, message: str, *keys: Key, line: int | None = None) -> CameraError:
        """Make an error about the value at a key path."""
        location = self.location(*keys)
        return CameraError(message, path=self.path, line=line or location.line, key=location.key)

    def get(self, *keys: Key) -> Any:
        """Value at a key path; None if the key is absent."""
        value = self.document
        for key in keys:
            if isinstance(value, Mapping):
                value = value.get(key)
            elif isinstance(value, list) and isinstance(key, int):
                value = value[key] if key < len(value) else None
            else:
                return None
        return value

    def has(self, *keys: Key) -> bool:
        """Whether there is a value at a key path."""
        return self.get(*keys) is not None

    def first(self, at: Keys, *keys: str) -> str | None:
        """The first of ``keys`` with a value in the mapping at the key path ``at``; None if no key has
        one."""
        return next((key for key in keys if self.has(*at, key)), None)

    def need(self, *keys: Key) -> Any:
        """Value at a key path that must be present."""
        value = self.get(*keys)
        if value is None:
            raise self.error("is missing", *keys)
        return value

    def mapping(self, *keys: Key) -> Mapping[Any, Any]:
        """Mapping at a key path."""
        value = self.need(*keys)
        if not isinstance(value, Mapping):
            raise self.error("needs keys and values", *keys)
        return value

    def items(self, *keys: Key) -> list[Any]:
        """Values of the list at a key path. Empty if the key is absent."""
        value = self.get(*keys)
        if not isinstance(value, list | None):
            raise self.error("needs a list", *keys)
        return value or []

    def paths(self, *keys: Key) -> list[Keys]:
        """Key paths of the items of the list at a key path."""
        return [(*keys, index) for index, _ in enumerate(self.items(*keys))]

    def elements(self, at: Keys, *tags: str) -> list[Keys]:
        """Key paths of XML elements below the key path ``at``. ``tags``: tag at each level below ``at``."""
        found = [at]
        for tag in tags:
            found = [path for one in found for path in self.paths(*one, tag)]
        return found

    def numbers(self, shape: tuple[int, ...], *keys: Key) -> Array:
        """Array of a shape from the numbers at a key path, in row order. Nested lists count as one list."""
        values = self.some_numbers(*keys)
        if len(values) != np.prod(shape):
            size = " x ".join(map(str, shape))
            raise self.error(f"needs {size} numbers, not {len(values)}", *keys)
        return values.reshape(shape)

    def some_numbers(self, *keys: Key, most: int = 1000) -> Array:
        """All numbers (N,) at a key path, in row order."""
        try:
            return np.array([to_number(v) for v in _flat(self.need(*keys), most)], dtype=float)
        except ValueError as reason:
            raise self.error(str(reason), *keys) from None

    def number(self, *keys: Key, otherwise: float | None = None) -> float:
        """Number at a key path. If the key is absent: ``otherwise``, or an error if this is None."""
        if otherwise is not None and self.get(*keys) is None:
            return otherwise
        return float(self.numbers((), *keys))

    def words(self, count: int, *keys: Key) -> Array:
        """Numbers (count,) of the text at a key path, which has spaces between them."""
        words = str(self.need(*keys)).split()
        if len(words) != count:
            raise self.error(f"needs {count} numbers, not {len(words)}", *keys)
        location = self.location(*keys)
        return np.array(self.row(words, location.line or 0, location.key))

    def unit_rotation(
        self, xyzw: Array, *keys: Key, line: int | None = None, slack: float = _LENGTH_SLACK
    ) -> Array:
        """Rotation (3, 3) of a quaternion (4,). Raises CameraError, which names the key path or the line, if
        the length differs from 1 by more than ``slack``."""
        length = float(np.linalg.norm(xyzw))
        if abs(length - 1) > slack:
            message = f"the quaternion is not a rotation: its length is {length:g}, not 1"
            raise self.error(message, *keys, line=line)
        return quaternion_to_matrix(xyzw / length)

    def check_count(self, model: str, distortion: Array, keys: Keys) -> None:
        """Raise CameraError if the number of coefficients (N,) at a key path does not fit the model."""
        counts = _FILE_COUNTS[model]
        used = len(np.trim_zeros(distortion, "b"))
        if used and (used > max(counts) or len(distortion) < min(counts)):
            count = " or ".join(map(str, counts))
            hint = "; thin prism and tilted sensor models are not supported" if len(distortion) > 8 else ""
            raise self.error(f"{model} has {count} coefficients, not {len(distortion)}{hint}", *keys)

    def optional_numbers(self, *keys: Key) -> Array:
        """All numbers (N,) at a key path, in row order. Empty, (0,), if the key is absent or the list is
        empty."""
        return np.zeros(0) if self.get(*keys) in (None, []) else self.some_numbers(*keys)

    def pose_matrix(self, *keys: Key, tolerance: float = 1e-9) -> Array:
        """Matrix (4, 4) of R and t at a key path. Raises CameraError if its last row differs from 0 0 0 1 by
        more than a tolerance."""
        matrix = self.numbers((4, 4), *keys)
        if not np.allclose(matrix[3], [0, 0, 0, 1], atol=tolerance):
            raise self.error("needs 0 0 0 1 as the last row of its 4 x 4 numbers", *keys)
        return matrix

    def size(self, width: Sequence[Key], height: Sequence[Key]) -> ImageSize:
        """Image size from the key paths of its width and height."""
        return self.positive_integer(*width), self.positive_integer(*height)

    def pair_size(self, *keys: Key) -> ImageSize | None:
        """Image size from a list of width and height; None if the key is absent."""
        return self.size_of(self.numbers((2,), *keys), *keys) if self.has(*keys) else None

    def size_of(self, values: Array, *keys: Key) -> ImageSize:
        """Image size from two numbers that were read at a key path."""
        if any(value != int(value) or value <= 0 for value in values):
            raise self.error("needs width and height, whole numbers above zero", *keys)
        return int(values[0]), int(values[1])

    def positive_integer(self, *keys: Key) -> int:
        """Positive integer at a key path."""
        value = float(self.numbers((), *keys))
        if value != int(value) or value <= 0:
            raise self.error(f"needs a whole number above zero, not {value:g}", *keys)
        return int(value)

    def projection(self, p: Array, where: SourceLocation, size: ImageSize | None = None) -> RawCamera:
        """Camera of a projection matrix (3, 4). ``where``: location of the matrix in a file."""
        try:
            # any size is good enough here, since the decomposition of P does not depend on it
            camera = Camera.from_projection_matrix(p, (1, 1))
        except CameraError as error:
            path = where.path or self.path
            raise CameraError(error.message, path=path, line=where.line, key=where.key) from None
        return RawCamera(camera.K, camera.R, camera.t, size=size, locations={"": where})

    def row(self, words: Iterable[str], line: int, key: str | None = None) -> list[float]:
        """Convert the words of a line of plain text to numbers."""
        try:
            return [to_number(word) for word in words]
        except ValueError as reason:
            raise CameraError(str(reason), path=self.path, line=line, key=key) from None

    def add(
        self, cameras: dict[str, _Camera], name: str, camera: _Camera, *keys: Key, line: int | None = None
    ) -> None:
        """Add a camera under a unique name.

        Args:
            cameras: Cameras of the file by name. The camera is added to them.
            name: Name of the camera.
            camera: Camera in the unit and axes of the file, or the mapping of its keys.
            keys: Key path of the camera, for errors.
            line: Line of the camera, for errors.
        """
        if name in cameras:
            raise self.error(f"there are two cameras with the name {name!r}", *keys, line=line)
        if len(cameras) >= MAX_CAMERAS:
            raise self.error(f"there are more than {MAX_CAMERAS} cameras", *keys, line=line)
        cameras[name] = camera

    def lines(self) -> Iterator[tuple[int, str]]:
        """Number (from 1) and text of each line, without empty lines and comments."""
        return ((n, line) for n, line in self.all_lines() if line and line[0] not in "#;")

    @cached_property
    def head(self) -> list[str]:
        """Texts of the first three of :meth:`lines`. Formats recognise a file by these texts."""
        return [line for _, line in islice(self.lines(), 3)]

    def all_lines(self) -> Iterator[tuple[int, str]]:
        """Number (from 1) and text of each line. Blanks at both ends are removed."""
        for number, line in enumerate(io.StringIO(self.text), 1):
            if len(line) > _LONGEST_LINE:
                raise CameraError("this line is too long for a calibration file", path=self.path, line=number)
            yield number, line.strip()


def is_number(word: str) -> bool:
    """Whether a word is a finite number."""
    return len(word) < 60 and _NUMBER.fullmatch(word) is not None


def to_number(value: Any) -> float:
    """Convert a value to a finite number. It may be text, since YAML 1.1 reads 1e-5 as text.

    Raises:
        ValueError: The value is not a finite number. The message has the reason.
    """
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise ValueError(f"{_short(value)!r} is not a number")
    try:
        number = float(value)
    except ValueError:
        raise ValueError(f"{_short(value)!r} is not a number") from None
    except OverflowError:
        number = np.inf
    if not np.isfinite(number):
        raise ValueError("a number is not finite (NaN or infinity)")
    if abs(number) > LARGEST:
        raise ValueError(f"{number:g} is too large for a camera")
    return number


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else type(value).__name__
    return text if len(text) <= 30 else text[:27] + "..."


def _flat(value: Any, most: int, depth: int = 4) -> list[Any]:
    """Items of nested lists as one list. Raises ValueError if there are more than ``most``, since YAML
    aliases can multiply the content of a small file."""
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


def without_suffix(name: str) -> str:
    """Name of a camera: the name of its image without the suffix."""
    return _IMAGE_SUFFIX.sub("", name)


#: Most keys above the cameras of a file.
_DEPTH = 3
#: Keys with the name of a camera, in order of precedence.
_NAMES = ("name", "camera_name", "camera", "cam_name", "id", "camera_id", "cam_id", "serial", "serial_number")

Predicate = Callable[[Any], bool]


def find_cameras(file: CalibrationFile, is_camera: Predicate, is_part: Predicate) -> list[tuple[str, Keys]]:
    """Find the cameras of a document. Returns their names and key paths, in the order of the file.

    Args:
        file: File that is being read.
        is_camera: Whether a value has all keys of a camera.
        is_part: Whether a value has some of these keys. Such a value counts as a camera if another item of
            the same list or mapping is a camera.

    Returns:
        Names and key paths; empty if the document has no cameras. In a list without names, the indices are
        names. If several groups (such as devices with streams) have cameras of the same names, the name of
        the group is put before each name.
    """
    paths = [()] if is_camera(file.document) else _search(file, (), is_camera, is_part)
    if len(paths) > MAX_CAMERAS:
        raise file.error(f"there are more than {MAX_CAMERAS} cameras")
    names = [_name(file, keys) for keys in paths]
    grouped = len({*names}) < len(names) and len({keys[:-1] for keys in paths}) > 1
    return [
        (f"{keys[-2]}_{name}" if grouped else name, keys) for name, keys in zip(names, paths, strict=True)
    ]


def _search(file: CalibrationFile, at: Keys, is_camera: Predicate, is_part: Predicate) -> list[Keys]:
    """Key paths of the cameras in a mapping or list, at most ``_DEPTH`` keys deep."""
    value = file.get(*at)
    keys = value if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    items = {(*at, key): file.get(*at, key) for key in keys}
    if any(map(is_camera, items.values())):
        return [path for path, item in items.items() if is_camera(item) or is_part(item)]
    deeper = items if isinstance(value, dict) and len(at) < _DEPTH else ()
    return [path for one in deeper for path in _search(file, one, is_camera, is_part)]


def _name(file: CalibrationFile, keys: Keys) -> str:
    """Name of a camera: its key; in a list, the name that its values state, or else its index."""
    if keys and isinstance(file.get(*keys[:-1]), dict):
        return str(keys[-1])
    values = (file.get(*keys, key) for key in _NAMES)
    stated = (str(v).strip() for v in values if isinstance(v, (str, int)) and not isinstance(v, bool))
    return next(filter(None, stated), str(keys[-1]) if keys else Path(file.path).stem)


def has_keys(*needed: set[str]) -> Predicate:
    """Make a function that tells whether a value is a mapping with a key of each set in ``needed``."""
    return lambda value: isinstance(value, dict) and all(keys & value.keys() for keys in needed)


#: How many coefficients a file may have for each lens model. Further coefficients must be zero.
_FILE_COUNTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
#: Names of each model in lower case, with only letters and digits.
_NAMES_OF_MODELS = {
    "plumb_bob": "plumbbob radtan radialtangential brownconrady brown",
    "rational_polynomial": "rationalpolynomial rational radialtangential8 radtan8 pinholeradtan8",
    "equidistant": """equidistant equi equidistantcamera fisheye kannalabrandt kannalabrandt4 kannalabrandt8
        kb4""",
}
_ALIASES = {name: model for model, names in _NAMES_OF_MODELS.items() for name in names.split()}


def model_of(name: str) -> str | None:
    """Model in :data:`humansim_ros.cameras.camera.lens.MODELS` for a name in files; None for an unknown
    name."""
    return _ALIASES.get(re.sub("[^a-z0-9]", "", name.lower()))


#: Names of units in a file, and metres per unit.
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_LONG_UNITS = {"metre": "m", "centimetre": "cm", "millimetre": "mm"}


def metres_of(name: str) -> float | None:
    """Metres of a unit: m, cm or mm, or a long name in any spelling. Returns None for an unknown unit."""
    long = name.strip().lower().removesuffix("s").replace("meter", "metre")
    return UNITS.get(_LONG_UNITS.get(long, name.strip()))
