"""Cameras in JSON and TOML documents: a mapping or a list of cameras, at the top or below other keys."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from humansim_ros.camera.formats.base import CalibrationFile, Key

#: Most keys above the cameras of a file.
_DEPTH = 3
#: Keys of a camera that have its name, in order of precedence.
_NAMES = ("name", "camera_name", "camera", "cam_name", "id", "camera_id", "cam_id", "serial", "serial_number")

Keys = tuple[Key, ...]
Predicate = Callable[[Any], bool]


def find_cameras(file: CalibrationFile, is_camera: Predicate, is_part: Predicate) -> list[tuple[str, Keys]]:
    """Find the cameras of a document: their names and key paths, in the order of the file.

    Args:
        file: File that is being read.
        is_camera: Whether a value has all keys of a camera.
        is_part: Whether a value has some of these keys. Where one item is a camera, these are cameras too.

    Returns:
        Cameras; empty if the document has none. Cameras of a list without names have their indices as names.
        Names that several groups have, such as the streams of several devices, begin with that of the group.
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
    """Names and key paths of the cameras in a mapping or list, or below its keys.

    Args:
        value: Mapping or list; other values have no cameras.
        keys: Its key path.
        depth: Most keys above the cameras.
        is_camera: As for :func:`find_cameras`.
        is_part: As for :func:`find_cameras`.
    """
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
    """Name of a camera that has no key in a mapping."""
    for key in _NAMES:
        value = camera.get(key)
        if isinstance(value, (str, int)) and not isinstance(value, bool) and str(value).strip():
            return str(value).strip()
    return otherwise


def has_keys(*needed: set[str]) -> Predicate:
    """Function that tells whether a value is a mapping with a key of each of these sets."""
    return lambda value: isinstance(value, dict) and all(keys & value.keys() for keys in needed)
