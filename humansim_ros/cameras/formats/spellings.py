"""Parameters of cameras in documents of any layout, found by the spelling of their keys.

A document (JSON, npz, YAML, TOML) is a tree of keys. If a key is a known spelling of a camera parameter, its
value becomes an :class:`Entry`. The rest of the key path names the camera. So ``cam0.intrinsics.K``,
``intrinsics.cam0.K``, ``K.cam0``, ``K_cam0`` and the first matrix of a list ``K`` all are K of a camera.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import islice
from typing import Any

import numpy as np

from humansim_ros.cameras.formats.base import (
    MAX_CAMERAS,
    CalibrationFile,
    Key,
    Keys,
    SourceLocation,
    is_number,
    metres_of,
)
from humansim_ros.cameras.formats.syntax import BRACKETS, text_document
from humansim_ros.errors import CameraError
from humansim_ros.files.reading import read_table
from humansim_ros.types import Array, ImageSize


def words(text: str) -> frozenset[str]:
    """Set of the words of a text, separated by blanks."""
    return frozenset(text.split())


#: Spellings of each parameter, and keys of groups. They are in lower case, without separators between words.
CAMERA_KEYS = read_table("camera_keys")
_ROLES = {word: role for role, lines in CAMERA_KEYS["parameters"].items() for word in " ".join(lines).split()}
#: How many numbers a value of each parameter may have, largest first. A list of such values has one value for
#: each camera.
_COUNTS = {
    "K": (16, 9, 4),
    **dict.fromkeys(("R", "Rinverse"), (9, 3)),
    **dict.fromkeys(("rvec", "t", "center"), (3,)),
    "quaternion": (4,),
    "distortion": range(1, 15),
    **dict.fromkeys(("pose", "inverse", "P"), (16, 12)),
    **dict.fromkeys(("focal", "principal"), (2, 1)),
    "size": (2,),
    "shape": (3, 2),
    "radial": (6, 3, 2),
    "tangential": (2,),
    "params": (12, 8, 5, 4, 3),
    "rectification": (9,),
    "rectified": (12,),
}
_TEXTS = ("model", "name", "names", "fisheye")
#: Parameters that are single numbers.
SCALARS = (
    *("fx", "fy", "cx", "cy", "skew", "alpha", "width", "height"),
    *("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"),
)
INTRINSIC = frozenset({"K", "fx", "focal", "P", "params"})
ROTATION = frozenset({"R", "Rinverse", "rvec", "quaternion", "pose", "inverse", "P"})
TRANSLATION = frozenset({"t", "center", "pose", "inverse", "P"})
POSE = ROTATION | TRANSLATION
_MOVED = TRANSLATION - {"P"}
SIZE = frozenset({"width", "size", "shape"})
#: Keys of groups of parameters or cameras. They do not name a camera.
_GROUPS = words(" ".join(CAMERA_KEYS["groups"]))
#: Ends of keys of groups of the parameters of one camera, such as color_intrinsics.
_SECTION = re.compile(
    r"(.+?)[_. -]?(?:intrinsics?|extrinsics?|calibration|calib|params|parameters|pose|intri|extri)",
    re.IGNORECASE,
)
_NAMES_OF_LISTS = ("rvecs", "tvecs")
_MAX_DEPTH, _MAX_ENTRIES = 10, 100_000
_WORD = re.compile(r"[^a-z0-9]+")
#: Frames in keys that state the direction of a transform from ``a`` to ``b``: ``rotation_world_to_camera``,
#: ``cam_from_world``, ``world_T_cam``, ``R_cw``. Any words may be before and after the frames.
_FRAME = "(?P<{}>world|w|camera|cam|c)"
_DIRECTION = tuple(
    re.compile(text.format(_FRAME.format("a"), _FRAME.format("b")))
    for text in ("(.*?){}(?:to|2){}(.*)", "(.*?){1}from{0}(.*)", "(.*?){1}t{0}(.*)", "(.+?){1}{0}(.*)")
)
_WHOLE = {""} | words(
    "h t mat matrix tf transform transformation transformationmatrix rt se3 pose extrinsics extrinsic"
)
#: Parameters from the world to the camera, and the same parameters from the camera to the world.
_OPPOSITES = {"R": "Rinverse", "t": "center", "pose": "inverse"}
#: Ends of keys of single numbers that together make a vector, a quaternion or a matrix; and their parameters.
_ENDS = (
    ({"x", "y", "z"}, "R rvec t center P"),
    ({"w", "x", "y", "z"}, "R quaternion"),
    *(
        ({f"{i + first}{j + first}" for i in range(high) for j in range(wide)}, "K R P pose inverse")
        for high, wide in ((3, 3), (3, 4), (4, 4))
        for first in (0, 1)
    ),
    *((set(ends.split()), "t center") for ends in ("1 2 3", "0 1 2", "11 21 31")),
    *(({str(i + first) for i in range(n)}, "distortion") for n in (4, 5, 8) for first in (0, 1)),
)
#: Keys of vectors and quaternions with components as separate keys, by parameter and number of components.
_TURNED = {
    **dict.fromkeys((("R", 4), ("quaternion", 4)), "quaternion_xyzw"),
    ("R", 3): "rxyz",
    ("P", 3): "position",
}
_END = re.compile(r"(.+?)[_. -]?([wxyz]|[0-9]_?[0-9]?)")
#: Pattern of keys that end with a unit: ``translation_mm``, ``T_left_cm``, ``position (m)``.
_UNIT = re.compile(r"(.+?)[_. (\[-]+(?:in[_ ])?([cm]?m|(?:milli|centi)?met(?:er|re)s?)[)\]]?", re.IGNORECASE)
_PART = re.compile("t[xyz]", re.IGNORECASE)
#: Words that do not name a camera: ``F_threshold`` is no focal length of a camera ``threshold``.
_NO_CAMERA = words(
    """threshold thresh thres min max mean num number noise std sigma var weight rate freq tol eps ratio prior
    init"""
)
#: Keys of angles. They are no rotation vectors.
_ANGLES = re.compile(r"euler|rpy|ypr|yaw|pitch|roll|degree", re.IGNORECASE)
_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?")

#: Parameters of COLMAP's camera models. The coefficients have the names of ``lens.MODELS``.
COLMAP_PARAMETERS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
}
#: Names of all camera models, also of those that cannot be read.
COLMAP_MODELS = (*COLMAP_PARAMETERS, "FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE")

#: Name of the camera of an entry: parts of its key path.
Identity = tuple[str, ...]


@dataclass(frozen=True)
class Entry:
    """A camera parameter in a file. ``key``: its spelling in the file, in lower case."""

    file: CalibrationFile
    keys: Keys
    key: str = ""

    @property
    def value(self) -> Any:
        """Value in the file."""
        return self.file.get(*self.keys)

    @property
    def word(self) -> str:
        """Value in the file as a text in lower case."""
        return str(self.value).strip().lower()

    @property
    def location(self) -> SourceLocation:
        """Location with the path of the file."""
        return replace(self.file.location(*self.keys), path=self.file.path)

    def numbers(self, *shape: int) -> Array:
        """Numbers of the value as an array of a shape. If no shape is given, the array is (N,)."""
        return self.file.numbers(shape, *self.keys) if shape else self.file.some_numbers(*self.keys)

    def error(self, message: str) -> CameraError:
        """Error about the value."""
        return self.file.error(message, *self.keys)


@dataclass
class Found:
    """Parameters of the cameras of one or two files. ``cameras``: entries by camera, then by parameter, in
    the order of the files. ``names``: lists of names of cameras. ``views``: whether rvecs and tvecs are poses
    of a board, as ``cv2.calibrateCamera`` returns them."""

    cameras: dict[Identity, dict[str, Entry]] = field(default_factory=dict)
    names: list[str] = field(default_factory=list)
    views: bool = False

    @property
    def roles(self) -> set[str]:
        """Parameters that at least one camera has."""
        return {role for entries in self.cameras.values() for role in entries}

    def having(self, roles: frozenset[str]) -> list[Identity]:
        """Cameras that have at least one of these parameters, not counting shared parameters."""
        return [identity for identity, entries in self.cameras.items() if roles & entries.keys()]

    def entries_of(self, identity: Identity) -> dict[str, Entry]:
        """Parameters of a camera, including those that it shares with other cameras."""
        entries: dict[str, Entry] = {}
        for length in range(len(identity) + 1):
            entries |= self.cameras.get(identity[:length], {})
        return entries


def size_of(entries: Mapping[str, Entry]) -> ImageSize | None:
    """Image size of a camera with these parameters; None if none of them states it."""
    width, height = entries.get("width"), entries.get("height")
    if width is not None and height is not None:
        return width.file.positive_integer(*width.keys), height.file.positive_integer(*height.keys)
    if "size" in entries:
        return entries["size"].file.pair_size(*entries["size"].keys)
    if "shape" in entries:
        shape = entries["shape"]
        return shape.file.size_of(shape.numbers()[1::-1], *shape.keys)
    return None


def role_of(key: Key) -> str | None:
    """Camera parameter that a key spells; None for any other key."""
    return _ROLES.get(_word(split_unit(key)[0])) if isinstance(key, str) else None


def split_unit(key: str) -> tuple[str, float | None]:
    """Key of a translation without the unit at the end, and metres per unit; None if the key has no unit."""
    match = _UNIT.fullmatch(key) if len(key) < 60 else None
    moved = match and (_PART.fullmatch(match[1]) or any(r in _MOVED for r, _ in _candidates(match[1])))
    return (match[1], metres_of(match[2].lower())) if match and moved else (key, None)


def unit_of_keys(file: CalibrationFile) -> float | None:
    """Metres per unit that keys such as ``translation_mm`` state; None if no key does. Raises CameraError."""
    units = {key: unit for key in keys_of(_parsed(file)) if (unit := split_unit(key)[1])}
    if len({*units.values()}) > 1:
        raise CameraError(f"has several units: {', '.join(sorted(units))}; give one", path=file.path)
    return next(iter(units.values()), None)


def _word(key: str) -> str:
    return _WORD.sub("", key.lower()) if len(key) < 60 else ""


def find_parameters(*files: CalibrationFile) -> Found:
    """Find the camera parameters of documents."""
    found = Found()
    for file in files:
        plural = {_word(str(key)) for key in file.document} if isinstance(file.document, Mapping) else set()
        found.views = found.views or plural.issuperset(_NAMES_OF_LISTS)
        for count, (keys, shape) in enumerate(leaves_of(file)):
            if count > _MAX_ENTRIES:
                raise file.error(f"has more than {_MAX_ENTRIES} values")
            _add(found, file, keys, shape)
    if found.views:
        _leave_out_views(found)
    for identity, entries in found.cameras.items():
        if "params" in entries and colmap_model(found.entries_of(identity)) is None:
            del entries["params"]
    sure = any({"K", "fx", "P"} & entries.keys() for entries in found.cameras.values())
    found.cameras = {  # a camera with nothing but f is no camera if there is a K: f is another number there
        identity: entries
        for identity, entries in found.cameras.items()
        if entries and not (sure and entries.keys() == {"focal"})
    }
    return found


def colmap_model(entries: Mapping[str, Entry]) -> str | None:
    """Name of COLMAP's camera model in these parameters; None if they have no model, or none of COLMAP's."""
    model = str(entries["model"].value).strip().upper() if "model" in entries else ""
    return model if model in COLMAP_MODELS else None


def _leave_out_views(found: Found) -> None:
    """Remove ``rvecs`` and ``tvecs``, unless there is one of them for each camera with K."""
    listed = {
        identity
        for identity, entries in found.cameras.items()
        if any(entries[role].key in _NAMES_OF_LISTS for role in ("rvec", "t") if role in entries)
    }
    if len(listed) > 1 and listed == {one for one, entries in found.cameras.items() if "K" in entries}:
        found.views = False
        return
    for entries in found.cameras.values():
        for role in ("rvec", "t"):
            if role in entries and entries[role].key in _NAMES_OF_LISTS:
                del entries[role]


#: Keys of the components of vectors and quaternions that are written as mappings.
_COMPONENTS = (
    ("x", "y", "z"),
    ("tx", "ty", "tz"),
    ("x", "y", "z", "w"),
    ("qx", "qy", "qz", "qw"),
    ("rx", "ry", "rz"),
)
_MAX_NORMALISED = 200_000


def plain(
    file: CalibrationFile, rewrite: Callable[[dict[Any, Any]], dict[Any, Any]] = lambda x: x, least: int = 2
) -> CalibrationFile:
    """Replace mappings of x, y, z (and w), and single numbers such as K11 to K33, by lists. Texts of numbers
    become numbers. The key of a quaternion gets the end ``_xyzw``, which states its order. Plain text becomes
    a document. ``rewrite``: changes the items of each mapping. ``least``: see :func:`_named`."""
    file = _parsed(file)
    names: dict[str, str] = {}
    budget = _MAX_NORMALISED

    def convert(value: Any, depth: int = 0, above: Key = "") -> Any:
        nonlocal budget
        budget -= 1
        if depth > _MAX_DEPTH or budget < 0:
            return value
        if isinstance(value, Mapping):
            items = {}
            for given, item in value.items():
                key = split_unit(given)[0] if isinstance(given, str) else given
                if key != given:
                    key = given if key in value else key
                    names[key] = given
                vector = _vector(item)
                if vector is None:
                    items[key] = convert(_simple(key, item), depth + 1, key)
                else:
                    items[f"{key}_xyzw" if len(vector) == 4 else key] = vector
            return _joined(rewrite(_named(items, 1 if above == "cameras" else least, names)))
        if isinstance(value, list):
            if value and all(isinstance(item, str) and _NUMBER.fullmatch(item.strip()) for item in value):
                return [float(item) for item in value]
            if len(value) == 2 and isinstance(value[0], (int, float)) and isinstance(value[1], list):
                return [value[0], *value[1]]  # a quaternion of a real and an imaginary part
            return [convert(item, depth + 1) for item in value]
        return value

    return replace(file, document=convert(file.document), renamed={**names, **file.renamed})


def _parsed(file: CalibrationFile) -> CalibrationFile:
    """The file with ``document`` set, also for plain text with keys and values."""
    no_document = file.document is None and file.syntax == "text"
    return text_document(file, role_of) if no_document else file


def _simple(key: Any, value: Any) -> Any:
    """Convert a text such as "1 0 0.5" to numbers, and an element of XML to its text. Other values are
    unchanged."""
    if isinstance(value, list) and len(value) == 1 and isinstance(value[0], dict) and [*value[0]] == ["text"]:
        value = value[0]["text"]
    words = value.translate(BRACKETS).split() if isinstance(value, str) and len(value) < 2000 else []
    several = len(words) > 1 and role_of(key) not in _TEXTS and all(map(is_number, words))
    return [float(word) for word in words] if several else value


def _joined(items: dict[Any, Any]) -> dict[Any, Any]:
    """The items, with the single numbers of a vector, a quaternion or a matrix joined to a list."""
    parts: dict[str, dict[str, Any]] = {}
    for key, item in items.items():
        end = _END.fullmatch(key) if isinstance(key, str) and len(key) < 60 else None
        single = not isinstance(item, bool) and is_number(str(item).strip())
        if end and single and (end[2] not in "xy" or role_of(key) not in SCALARS or f"{end[1]}z" in items):
            parts.setdefault(end[1], {})[end[2].replace("_", "")] = key
    for stem, keys in parts.items():
        role = role_of(stem)
        if any(keys.keys() == ends and role in roles.split() for ends, roles in _ENDS):
            values = [
                float(items.pop(keys[end])) for end in sorted(keys, key=lambda end: end.replace("w", "~"))
            ]
            items.setdefault(_TURNED.get((str(role), len(values)), stem), values)
    return items


@lru_cache(maxsize=1)
def keys_of(file: CalibrationFile) -> set[str]:
    """Keys of a document, in which all formats look for theirs. If the document is large, only those of its
    first thousands of values."""
    return {str(key) for keys, _ in islice(leaves_of(file), 2000) for key in keys}


def leaves_of(file: CalibrationFile) -> Iterator[tuple[Keys, tuple[int, ...] | str]]:
    """Numbers, lists of numbers and texts of a document: key path, and shape or text of each."""
    return _leaves(file.document, (), 0)


def _vector(value: Any) -> list[float] | None:
    """Numbers of a mapping of x, y, z (and w); None for other values."""
    if not isinstance(value, Mapping) or not 3 <= len(value) <= 4:
        return None
    by_key = {str(key).lower(): number for key, number in value.items()}
    names = next((names for names in _COMPONENTS if by_key.keys() == set(names)), ())
    numbers = [by_key[name] for name in names]
    known = all(isinstance(number, (int, float)) and not isinstance(number, bool) for number in numbers)
    return numbers if numbers and known else None


_Shape = tuple[int, ...] | str


def _leaves(value: Any, keys: Keys, depth: int) -> Iterator[tuple[Keys, _Shape]]:
    """Numbers, lists of numbers and texts below a key: key path, and shape or text of each."""
    if depth > _MAX_DEPTH:
        return
    shape = shape_of(value)
    if shape is not None:
        yield keys, shape
    elif isinstance(value, Mapping):
        if "data" in value and shape_of(value["data"]) is not None and {"rows", "cols"} <= value.keys():
            yield (*keys, "data"), shape_of(value["data"]) or ()
            return
        for key, item in value.items():
            yield from _leaves(item, (*keys, key), depth + 1)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _leaves(item, (*keys, index), depth + 1)


def shape_of(value: Any, depth: int = 5) -> _Shape | None:
    """Shape of nested lists of numbers. A text is returned unchanged. None for other values."""
    if isinstance(value, (bool, str)):
        return str(value)
    if isinstance(value, (int, float)):
        return ()
    if not isinstance(value, (list, tuple)) or not value or depth == 0:
        return None
    if all(isinstance(item, str) for item in value):
        return None if len(value) > 1000 else "\0"
    first = shape_of(value[0], depth - 1)
    return None if first is None or isinstance(first, str) else (len(value), *first)


def _add(found: Found, file: CalibrationFile, keys: Keys, shape: _Shape) -> None:
    """Add a value of a document if its key is known."""
    spelled = _spelled(keys, shape)
    if spelled is None:
        return
    role, at, identity = spelled
    key = _word(str(keys[at]))
    if role == "names":
        names = file.get(*keys)
        if isinstance(names, list):
            found.names = [str(name) for name in names][:1000]
        return
    count = _count(role, shape)
    if count is None:
        return
    for index in range(count) if count else (None,):
        own = identity if index is None else (*identity, str(index))
        if own not in found.cameras and len(found.cameras) > 2 * MAX_CAMERAS:
            raise file.error(f"there are more than {MAX_CAMERAS} cameras", *keys)
        path = keys if index is None else (*keys, index)
        found.cameras.setdefault(own, {}).setdefault(role, Entry(file, path, key))


def _spelled(keys: Keys, shape: _Shape) -> tuple[str, int, Identity] | None:
    """Parameter of a value, the place of its key in the path, and the camera; None for an unknown value."""
    last = len(keys) - 1
    if keys and keys[-1] == "data" and last:
        last -= 1
    for at in range(last, max(last - 2, -1), -1):
        key = keys[at]
        if not isinstance(key, str) or _ANGLES.search(key):
            continue
        fitting = ((role, extra) for role, extra in _candidates(key) if _count(role, shape) is not None)
        role, extra = next(fitting, (None, ()))
        if role is None or (at < last and role in (*SCALARS, *_TEXTS)):
            continue
        parts = [*_parts(keys[:at]), *extra, *(str(k) for k in keys[at + 1 : last + 1])]
        return role, at, tuple(parts)
    return None


def _candidates(key: str) -> Iterator[tuple[str, Identity]]:
    """Parameters that a key may spell with the camera that it names, the most certain first. ``K_left``,
    ``left_K`` and ``K1`` are K of a camera, ``R_world_to_camera`` has a direction."""
    word = _word(key)
    role, numbered = _ROLES.get(word), _numbered(key)
    if role in SCALARS and numbered is not None:
        yield numbered  # K1 with 3 x 3 numbers is K, not k1, so the sizes decide
    if role is not None:
        yield role, ()
    for directed in (pattern.fullmatch(word) for pattern in _DIRECTION):
        if directed is None or directed["a"][0] == directed["b"][0]:
            continue
        rest = directed[1] + directed[4]
        for base in (_ROLES.get(rest, "").replace("inverse", "pose"), "pose" if rest in _WHOLE else ""):
            if base in _OPPOSITES:
                yield (_OPPOSITES[base] if directed["a"][0] == "c" else base), ()
    if role is None:
        yield from _split(key)  # T_pose is t of pose, so the sizes decide
        if numbered is not None:
            yield numbered


def _numbered(key: str) -> tuple[str, Identity] | None:
    """Parameter and camera of a key that ends with a number, such as ``K1``."""
    match = re.fullmatch(r"([A-Za-z_]+?)_?([0-9]+)", key) if len(key) < 80 else None
    role = _ROLES.get(_word(match[1])) if match else None
    known = ("K", "R", "t", "rvec", "pose", "distortion", "P", "rectified", "rectification")
    return (str(role), (match[2],)) if match and role in known else None


def _split(key: str) -> Iterator[tuple[str, Identity]]:
    """Parameters and cameras that a key with words of both may mean, such as ``K_left`` and ``left_K``."""
    ends = [match.span() for match in re.finditer(r"[^_. -]+", key)]
    if len(ends) > 8 or len(key) > 80:
        return
    for length in range(len(ends) - 1, 0, -1):
        last, first = ends[-length][0], ends[length - 1][1]
        for own, rest in ((key[last:], key[:last]), (key[:first], key[first:])):
            role, rest = _ROLES.get(_word(own)), rest.strip("_. -")
            named = role not in _TEXTS or (role == "model" and _word(own) != own.lower())
            if role is not None and named and not _NO_CAMERA.intersection(re.split("[_. -]+", rest.lower())):
                yield role, (rest,)


def _parts(keys: Keys) -> Identity:
    """Parts of a key path that name a camera."""
    parts: list[str] = []
    for key in keys:
        word = _word(key) if isinstance(key, str) else ""
        if word in _GROUPS:
            continue
        section = _SECTION.fullmatch(key) if isinstance(key, str) and len(key) < 80 else None
        parts.append(section[1] if section else str(key))
    return tuple(parts)


def _named(items: dict[Any, Any], least: int, names: dict[str, str]) -> dict[Any, Any]:
    """The items. If ``least`` of them are cameras, or two have K, the word of a group that is the key of such
    an item, as color may be, becomes its name. ``names``: gets the old key by the new one."""
    groups = {key for key in items if _parts((key,)) != (str(key),)}
    whole = {key: is_camera(value) for key, value in items.items() if groups and _has_k(key, value)}
    if sum(whole.values()) < least and len(whole) < 2:
        return items
    result: dict[Any, Any] = {}
    for key, value in items.items():
        own = key
        if key in groups and key in whole:
            own = next(new for n in range(len(items)) if (new := f"{key}_{n}") not in items)
            names[own], value = key, {"name": key, **value}
        result[own] = value
    return result


def _has_k(key: Key, value: Any) -> bool:
    """Whether a value is a camera, or K or fx is below a key that may be a name. The key k may be a lens."""
    below = islice(value, 100) if isinstance(value, Mapping) and role_of(key) in (None, "name") else ()
    return is_camera(value) or any(role_of(one) in ("K", "fx") and one != "k" for one in below)


def is_camera(value: Any) -> bool:
    """Whether a mapping has intrinsics and extrinsics of a camera."""
    roles = {role_of(key) for key in islice(value, 100)} if isinstance(value, Mapping) else set()
    return not roles.isdisjoint(INTRINSIC) and not roles.isdisjoint(POSE)


def _count(role: str, shape: _Shape) -> int | None:
    """Number of cameras in a list of values; 0 for a single value; None if the shape does not fit."""
    if isinstance(shape, str):
        return 0 if role in _TEXTS or (role in SCALARS and is_number(shape)) else None
    size = int(np.prod(shape))
    if role in (*_TEXTS, *SCALARS):
        several = role in SCALARS and len(shape) == 1
        return 0 if size == 1 else size if several else None
    if role == "params" and len(shape) == 2:
        return shape[0]
    if role == "K" and size == 4 and 4 not in shape:
        return None  # 2 x 2 numbers are ambiguous
    depth, counts = len(shape), _COUNTS[role]
    lists = {"R": depth > 2 and size == 3, "distortion": depth > 1 and 1 not in shape}
    if size in counts and not lists.get(role):
        return 0
    each = size // shape[0] if depth > 1 and (role != "distortion" or depth < 4) else 0
    return shape[0] if each in counts else None


def check_counts(file: CalibrationFile) -> None:
    """Raise CameraError if a key of a camera parameter has a number of values that the parameter cannot
    have."""
    for keys, shape in leaves_of(file):
        own = keys[:-1] if keys[-1:] == ("data",) else keys
        counts = _COUNTS.get(role_of(own[-1]) or "", ()) if own else ()
        if counts and not isinstance(shape, str) and _spelled(keys, shape) is None:
            known = " or ".join(map(str, sorted(counts)))
            raise file.error(f"needs {known} numbers, not {int(np.prod(shape))}", *own)


def numbers_found(file: CalibrationFile, most: int = 4, least: int = 1) -> list[str]:
    """For messages: first unknown keys with at least ``least`` numbers in a document, and the shapes."""
    found: list[str] = []
    for count, (keys, shape) in enumerate(leaves_of(file)):
        if len(found) == most or count > 1000:
            break
        known = not isinstance(shape, tuple) or int(np.prod(shape)) < least or _spelled(keys, shape)
        if shape and not known:
            key = ".".join(str(key) for key in keys)[-60:]
            found.append(f"{key} ({' x '.join(map(str, shape))})")
    return found
