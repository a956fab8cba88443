"""Shared parts of the calibration formats: parsed files, lists of cameras, lens models, rotations, numbers.

A format reads a :class:`CalibrationFile` into :class:`RawCamera` objects in the unit and axes of the file. It
writes cameras that are already in this unit and these axes. ``cameras/formats/calibration.py`` does the
conversion.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count, islice
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, indent, tostring

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from humansim_ros.cameras.camera.lens import MODELS, Lens, fit_lens
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.files.yaml import line_of
from humansim_ros.geometry import quaternion_to_matrix
from humansim_ros.types import Array, ImageSize

Key = str | int

#: Largest magnitude of a number. Cameras have smaller numbers, and the cubes of larger numbers overflow.
LARGEST = 1e15
#: Longest line in characters. A line of COLMAP may hold a hundred thousand points of an image.
_LONGEST_LINE = 4 << 20
#: From the camera axes of OpenGL (x right, y up, z backward) to those of OpenCV, as a transform.
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
#: ``OPENGL`` as a rotation (3, 3).
FLIP = OPENGL[:3, :3]
#: The length of a quaternion may differ from 1 by this.
_LENGTH_SLACK = 1e-2
#: Most cameras of a file.
MAX_CAMERAS = 10_000
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[+-]?\.?(?:nan|inf|infinity)", re.IGNORECASE)
#: Suffixes of images, for formats that name cameras after their images.
_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")


@dataclass(frozen=True)
class SourceLocation:
    """Key and line of a value in a file. ``path``: the file, if it is another one than the file that is being
    read."""

    key: str | None = None
    line: int | None = None
    path: str | None = None


@dataclass(frozen=True)
class RawCamera:
    """A camera in the unit and the world axes of its file. ``K`` (3, 3), ``R`` (3, 3), ``t`` (3,): x_cam = R
    x + t. The camera may have ``center`` (3,) in place of t. R is None if the file has no extrinsics of the
    camera. ``locations``: place in the file of each of these values, and of the camera under ""."""

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

    @property
    def rotation(self) -> Array:
        """R, or the identity if the camera has no extrinsics."""
        return np.eye(3) if self.R is None else self.R

    @property
    def position(self) -> Array:
        """Camera centre (3,) in the unit and axes of the file."""
        return -self.rotation.T @ self.t if self.center is None else self.center


@dataclass(frozen=True)
class CalibrationFile:
    """A calibration file that is being read: its text and, except for plain text, its parsed content.

    Keys are paths into ``document``. A wrong value raises CameraError, which names the file, the key, and the
    line if it is known. ``tree``: nodes of YAML. ``key_lines``: lines of the keys of TOML. ``given_size``:
    image size that the caller knows. ``syntax``: see ``CalibrationFormat``. ``renamed``: name in the file by
    key of ``document``, where both differ.
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
        """Error about the value at a key path."""
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

    def numbers(self, shape: tuple[int, ...], *keys: Key) -> Array:
        """Array of a shape from numbers in row order. The nesting of their lists is ignored."""
        values = self.some_numbers(*keys)
        if len(values) != np.prod(shape):
            size = " x ".join(map(str, shape))
            raise self.error(f"needs {size} numbers, not {len(values)}", *keys)
        return values.reshape(shape)

    def some_numbers(self, *keys: Key, most: int = 1000) -> Array:
        """All numbers (N,) of a value in row order."""
        try:
            return np.array([to_number(v) for v in _flat(self.need(*keys), most)], dtype=float)
        except ValueError as reason:
            raise self.error(str(reason), *keys) from None

    def number(self, *keys: Key, otherwise: float | None = None) -> float:
        """Number at a key path. If the key is absent, ``otherwise`` is returned, if given."""
        if otherwise is not None and self.get(*keys) is None:
            return otherwise
        return float(self.numbers((), *keys))

    def words(self, count: int, *keys: Key) -> Array:
        """Numbers (count,) of a text with spaces between them."""
        words = str(self.need(*keys)).split()
        if len(words) != count:
            raise self.error(f"needs {count} numbers, not {len(words)}", *keys)
        location = self.location(*keys)
        return np.array(self.row(words, location.line or 0, location.key))

    def unit_rotation(self, xyzw: Array, *keys: Key, line: int | None = None) -> Array:
        """Rotation (3, 3) of a quaternion (4,) from a key path or a line. Its length must be about 1."""
        length = float(np.linalg.norm(xyzw))
        if abs(length - 1) > _LENGTH_SLACK:
            message = f"the quaternion is not a rotation: its length is {length:g}, not 1"
            raise self.error(message, *keys, line=line)
        return quaternion_to_matrix(xyzw / length)

    def optional_numbers(self, *keys: Key) -> Array:
        """All numbers (N,) of a value in row order. Empty, (0,), if the key is absent or the list is
        empty."""
        return np.zeros(0) if self.get(*keys) in (None, []) else self.some_numbers(*keys)

    def pose_matrix(self, *keys: Key, rows: int, tolerance: float = 1e-9) -> Array:
        """Matrix (3, 4) or (4, 4) of R and t. A fourth row must be 0 0 0 1 to a tolerance."""
        matrix = self.numbers((rows, 4), *keys)
        if rows == 4 and not np.allclose(matrix[3], [0, 0, 0, 1], atol=tolerance):
            raise self.error("needs 0 0 0 1 as the last row of its 4 x 4 numbers", *keys)
        return matrix

    def locations(self, at: Sequence[Key], **parts: str | Sequence[Key]) -> dict[str, SourceLocation]:
        """Locations of a camera and of its values. ``parts``: keys of the values, or key paths below that of
        the camera."""
        paths = {part: (key,) if isinstance(key, str) else key for part, key in parts.items()}
        return {"": self.location(*at), **{part: self.location(*at, *keys) for part, keys in paths.items()}}

    def size(self, width: Sequence[Key], height: Sequence[Key]) -> ImageSize:
        """Image size from the key paths of its width and height."""
        return self.positive_integer(*width), self.positive_integer(*height)

    def pair_size(self, *keys: Key) -> ImageSize | None:
        """Image size from a list of width and height; None if the key is absent."""
        if self.get(*keys) is None:
            return None
        values = self.numbers((2,), *keys)
        if any(value != int(value) or value <= 0 for value in values):
            raise self.error("needs width and height, whole numbers above zero", *keys)
        return int(values[0]), int(values[1])

    def positive_integer(self, *keys: Key) -> int:
        """Positive integer at a key path."""
        value = float(self.numbers((), *keys))
        if value != int(value) or value <= 0:
            raise self.error(f"needs a whole number above zero, not {value:g}", *keys)
        return int(value)

    def row(self, words: Iterable[str], line: int, key: str | None = None) -> list[float]:
        """Convert the words of a line of plain text to numbers."""
        try:
            return [to_number(word) for word in words]
        except ValueError as reason:
            raise CameraError(str(reason), path=self.path, line=line, key=key) from None

    def add(
        self, cameras: dict[str, RawCamera], name: str, camera: RawCamera, *keys: Key, line: int | None = None
    ) -> None:
        """Add a camera under a unique name.

        Args:
            cameras: Cameras of the file by name. The camera is added to them.
            name: Name of the camera.
            camera: Camera in the unit and axes of the file.
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
        """First three of :meth:`lines`. Formats recognise a file by them."""
        return [line for _, line in islice(self.lines(), 3)]

    def all_lines(self) -> Iterator[tuple[int, str]]:
        """Number (from 1) and text of each line. Blanks at both ends are removed."""
        start = 0
        for number in count(1):
            end = self.text.find("\n", start)
            line = self.text[start : end if end >= 0 else None].strip()
            if len(line) > _LONGEST_LINE:
                raise CameraError("this line is too long for a calibration file", path=self.path, line=number)
            yield number, line
            if end < 0:
                return
            start = end + 1


def is_number(word: str) -> bool:
    """Whether a word is a finite number."""
    return len(word) < 60 and _NUMBER.fullmatch(word) is not None


def to_number(value: Any) -> float:
    """Convert a value to a finite number. It may be text, since YAML 1.1 reads 1e-5 as text.

    Raises:
        ValueError: The value is not a finite number. The message has the reason.
    """
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
        raise ValueError(f"{number:g} is too large for a camera")
    return number


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else type(value).__name__
    return text if len(text) <= 30 else text[:27] + "..."


def _flat(value: Any, most: int, depth: int = 4) -> list[Any]:
    """Items of nested lists, at most ``most``, since YAML aliases can multiply the content of a small
    file."""
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
    """Shortest text that reads back as the same number."""
    return repr(float(value) + 0.0)  # adding 0.0 turns -0.0 into 0.0


def row(values: Iterable[float], between: str = " ") -> str:
    """Numbers on one line."""
    return between.join(number(v) for v in values)


def nested(matrix: Array | Sequence[float]) -> list[Any]:
    """Nested lists of a matrix for JSON. -0.0 becomes 0.0."""
    return (np.asarray(matrix, dtype=float) + 0.0).tolist()


def json_file(content: Any) -> dict[str, str]:
    """Texts by file name, for a format that consists of one JSON file."""
    return {"": json.dumps(content, indent=1) + "\n"}


def xml_file(content: Mapping[str, Any]) -> dict[str, str]:
    """Texts by file name, for a format that consists of one XML file. ``content`` is what readers see:
    attributes, and lists of elements by tag."""

    def element(tag: str, content: Mapping[str, Any]) -> Element:
        below = {k: v for k, v in content.items() if isinstance(v, list) and isinstance(v[0], dict)}
        texts = {key: text_of(value) for key, value in content.items() if key not in below}
        one = Element(tag)
        one.text = texts.pop("text", None)
        one.attrib.update(texts)
        one.extend(element(key, item) for key, items in below.items() for item in items)
        return one

    ((tag, inside),) = content.items()
    root = element(tag, inside)
    indent(root)
    return {"": f'<?xml version="1.0" encoding="UTF-8"?>\n{tostring(root, "unicode")}\n'}


def text_of(value: Any) -> str:
    """Convert to text: a number, or a list of numbers with blanks between them. A text is unchanged."""
    if isinstance(value, list):
        return " ".join(map(text_of, value))
    return number(value) if isinstance(value, float) else str(value)


def without_suffix(name: str) -> str:
    """Name of a camera, made from the name of its image."""
    for suffix in _IMAGE_SUFFIXES:
        if name.lower().endswith(suffix) and len(name) > len(suffix):
            return name[: -len(suffix)]
    return name


def check_names(names: Iterable[str], words: bool = False) -> None:
    """Raise CameraError unless all names are printable. ``words``: they must be single words, for columns
    with blanks between."""
    for name in names:
        if words and (not name.isprintable() or name.split() != [name] or name[0] in "#;%/"):
            message = "this format needs a name without blanks that does not begin with # ; % or /"
            raise CameraError(message, key=name)
        if not name.isprintable() or name != name.strip() or not name:
            raise CameraError("this format needs a name without control characters", key=name)


def image_names(cameras: Iterable[str]) -> dict[str, str]:
    """Image names of cameras, for formats that name cameras after their images."""
    names = list(cameras)
    check_names(names, words=True)
    return {name: f"{name}.png" for name in names}


#: Most keys above the cameras of a file.
_DEPTH = 3
#: Keys with the name of a camera, in order of precedence.
_NAMES = ("name", "camera_name", "camera", "cam_name", "id", "camera_id", "cam_id", "serial", "serial_number")

Keys = tuple[Key, ...]
Predicate = Callable[[Any], bool]


def fitted_lens(file: CalibrationFile, what: str, ideal: Array, distorted: Array, focal: float) -> Lens:
    """Fit a lens to a lens model that cameras do not have. A warning states the error.

    Args:
        file: File that is being read.
        what: The lens, for the warning.
        ideal: Points (N, 2) of the normalised image plane, over the image.
        distorted: The same points (N, 2) after distortion.
        focal: Focal length, pixels.
    """
    lens, error = fit_lens(ideal, distorted)
    warn_about(
        file.path, f"{what} is written as {lens.model}, which differs by {error * focal:.2g} pixels (RMS)"
    )
    return lens


def find_cameras(file: CalibrationFile, is_camera: Predicate, is_part: Predicate) -> list[tuple[str, Keys]]:
    """Find the cameras of a document. Returns their names and key paths, in the order of the file.

    Args:
        file: File that is being read.
        is_camera: Whether a value has all keys of a camera.
        is_part: Whether a value has some of these keys. Such a value is a camera if another item next to it
            is one.

    Returns:
        Cameras; empty if the document has none. In a list without names, the indices are the names. If
        several groups (such as devices with streams) have the same names, each name begins with that of its
        group.
    """
    if is_camera(file.document):
        return [(_name(file.document, Path(file.path).stem), ())]
    found = list(_search(file.document, (), _DEPTH, is_camera, is_part))
    counts = Counter(name for name, _ in found)
    grouped = any(count > 1 for count in counts.values()) and len({keys[:-1] for _, keys in found}) > 1
    return [(f"{keys[-2]}_{name}" if grouped else name, keys) for name, keys in found]


def _search(
    value: Any, keys: Keys, depth: int, is_camera: Predicate, is_part: Predicate
) -> Iterator[tuple[str, Keys]]:
    """Names and key paths of the cameras in a mapping or list, at most ``depth`` keys deep."""
    if not isinstance(value, (dict, list)):
        return
    named = isinstance(value, dict)
    items: list[tuple[Key, Any]] = list(value.items() if isinstance(value, dict) else enumerate(value))
    if any(is_camera(item) for _, item in items):
        for key, item in items:
            if is_camera(item) or is_part(item):
                yield str(key) if named else _name(item, str(key)), (*keys, key)
    elif named and depth > 0:
        for key, item in items:
            yield from _search(item, (*keys, key), depth - 1, is_camera, is_part)


def _name(camera: Any, otherwise: str) -> str:
    """Name of a camera that is not under its own key in a mapping."""
    for key in _NAMES:
        value = camera.get(key)
        if isinstance(value, (str, int)) and not isinstance(value, bool) and str(value).strip():
            return str(value).strip()
    return otherwise


def reader_of(
    find: Callable[[CalibrationFile], list[tuple[str, Keys]]],
    read_camera: Callable[[CalibrationFile, Keys], RawCamera],
) -> tuple[Callable[[CalibrationFile], bool], Callable[[CalibrationFile], dict[str, RawCamera]]]:
    """Make the functions ``matches`` and ``read`` of a format.

    Args:
        find: Names and key paths of the cameras of a file, as from :func:`find_cameras`.
        read_camera: Reads the camera at a key path.
    """

    def read(file: CalibrationFile) -> dict[str, RawCamera]:
        cameras: dict[str, RawCamera] = {}
        for name, at in find(file):
            file.add(cameras, name, read_camera(file, at), *at)
        return cameras

    return lambda file: bool(find(file)), read


def has_keys(*needed: set[str]) -> Predicate:
    """Make a function that tells whether a value is a mapping with at least one key of each of these sets."""
    return lambda value: isinstance(value, dict) and all(keys & value.keys() for keys in needed)


#: Numbers of coefficients of each model in files. More coefficients may follow if they are zero.
_FILE_COUNTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
#: Names of each model in lower case, with only letters and digits.
_NAMES_OF_MODELS = {
    "plumb_bob": "plumbbob radtan radialtangential brownconrady brown",
    "rational_polynomial": "rationalpolynomial rational radialtangential8 radtan8 pinholeradtan8",
    "equidistant": """equidistant equi equidistantcamera fisheye kannalabrandt kannalabrandt4 kannalabrandt8
        kb4""",
}
_ALIASES = {name: model for model, names in _NAMES_OF_MODELS.items() for name in names.split()}
_NONE = ("", "none", "null", "no", "pinhole")
_KNOWN = ", ".join(MODELS)


def model_of(name: str) -> str | None:
    """Model in :data:`humansim_ros.cameras.camera.lens.MODELS` for a name in files; None for an unknown
    name."""
    return _ALIASES.get(re.sub("[^a-z0-9]", "", name.lower()))


def find_model(
    file: CalibrationFile,
    name: Any,
    distortion: Array,
    name_keys: tuple[Key, ...],
    distortion_keys: tuple[Key, ...],
) -> str | None:
    """Find the distortion model of a file, and check its number of coefficients.

    Args:
        file: File that is being read.
        name: Name of the model in the file, or None.
        distortion: Coefficients, (N,).
        name_keys: Key path of the name.
        distortion_keys: Key path of the coefficients.

    Returns:
        Name of the model in :data:`humansim_ros.cameras.camera.lens.MODELS`, or None for a lens without
        distortion. If the file has no name, the number of coefficients decides if it is unique.

    Raises:
        CameraError: The model is unknown, or its number of coefficients is wrong.
    """
    word = "" if name is None else str(name).strip().lower()
    if word in _NONE:
        return _model_without_name(file, word, distortion, name_keys)
    model = model_of(word)
    if model is None:
        raise file.error(f"unknown distortion model {name!r}; known are {_KNOWN}", *name_keys)
    check_count(file, model, distortion, distortion_keys)
    return model


def check_count(
    file: CalibrationFile, model: str, distortion: Array, distortion_keys: tuple[Key, ...]
) -> None:
    """Raise CameraError if the number of coefficients does not fit the model.

    Args:
        file: File that is being read.
        model: Name of the distortion model.
        distortion: Coefficients, (N,).
        distortion_keys: Key path of the coefficients.
    """
    counts = _FILE_COUNTS[model]
    used = len(np.trim_zeros(distortion, "b"))
    if used and (used > max(counts) or len(distortion) < min(counts)):
        count = " or ".join(map(str, counts))
        hint = "; thin prism and tilted sensor models are not supported" if len(distortion) > 8 else ""
        raise file.error(f"{model} has {count} coefficients, not {len(distortion)}{hint}", *distortion_keys)


def opencv_model(distortion: Array) -> str:
    """Model of OpenCV by the number of coefficients (N,) that are used. OpenCV files do not name the
    model."""
    return "plumb_bob" if len(np.trim_zeros(distortion, "b")) <= 5 else "rational_polynomial"


def _model_without_name(
    file: CalibrationFile, word: str, distortion: Array, name_keys: tuple[Key, ...]
) -> str | None:
    if not distortion.any():
        return None
    if word:
        raise file.error(
            f"is {word!r}, but there are distortion coefficients: name one of {_KNOWN}", *name_keys
        )
    count = len(distortion)
    model = {5: "plumb_bob", 8: "rational_polynomial"}.get(count)
    if model is None:
        raise file.error(
            f"is missing, and {count} coefficients do not determine it: add one of {_KNOWN}",
            *name_keys,
        )
    key = ".".join(map(str, name_keys))
    warn_about(file.path, f"{key} is missing; {count} coefficients are taken for {model}")
    return model


def rotation_of(file: CalibrationFile, *keys: Key) -> Array:
    """Matrix (3, 3) from 9 numbers in row order, or from a rotation vector of 3 numbers, radians."""
    values = file.some_numbers(*keys)
    if len(values) == 3:
        return np.asarray(Rotation.from_rotvec(values).as_matrix(), dtype=float)
    return file.numbers((3, 3), *keys)


def vector_of(rotation: Array) -> Array:
    """Rotation vector (3,) of a matrix (3, 3), radians."""
    return np.asarray(Rotation.from_matrix(rotation).as_rotvec(), dtype=float)


#: Names of units in a file, and metres per unit.
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_LONG_UNITS = {"metre": "m", "centimetre": "cm", "millimetre": "mm"}
#: Key paths of the unit.
_UNIT_KEYS = tuple(
    (*table, key)
    for table in ((), ("metadata",), ("info",), ("CameraParameters1",))
    for key in ("unit", "units", "WorldUnits", "world_units", "length_unit", "translation_unit")
)
#: If the extent of a rig exceeds this number of units, the unit is millimetres. It lies between a room of 30
#: m and 10 cm.
_MILLIMETRES = 50.0


def metres_of(name: str) -> float | None:
    """Metres of a unit: m, cm or mm, or a long name in any spelling. Returns None for an unknown unit."""
    long = name.strip().lower().removesuffix("s").replace("meter", "metre")
    return _UNITS.get(_LONG_UNITS.get(long, name.strip()))


def stated_unit(file: CalibrationFile) -> float | None:
    """Metres per unit of a file with a key such as ``unit``; None if no key states it. Raises CameraError for
    an unknown unit."""
    for keys in _UNIT_KEYS:
        value = file.get(*keys)
        if value is not None:
            unit = metres_of(str(value))
            if unit is None:
                raise file.error(f"is {str(value)[:30]!r}: use {', '.join(_UNITS)}", *keys)
            return unit
    return None


def find_unit(file: CalibrationFile, cameras: Mapping[str, RawCamera]) -> float:
    """Metres per unit of a file. Its key ``unit`` decides, or else the extent of the rig: metres or
    millimetres. If the unit is guessed, a HumansimWarning says so. Raises CameraError for an unknown unit."""
    stated = stated_unit(file)
    if stated is not None:
        return stated
    positions = np.array([camera.position for camera in cameras.values() if camera.R is not None])
    if not len(positions):
        return 1.0
    # the origin counts too, since it is the first camera or the board
    extent = float(np.linalg.norm(np.ptp(np.vstack([positions, np.zeros(3)]), axis=0)))
    if extent == 0:
        return 1.0
    name = "mm" if extent > _MILLIMETRES else "m"
    others = ", ".join(f"{extent * m:.5g} m with {u}" for u, m in sorted(_UNITS.items()) if u != name)
    warn_about(
        file.path,
        f"the unit is not in the file; {name} is assumed, because the cameras are then "
        f"{extent * _UNITS[name]:.3g} m apart ({others}); to state it, "
        f'set unit, or add unit = "{name}" to the file',
    )
    return _UNITS[name]
