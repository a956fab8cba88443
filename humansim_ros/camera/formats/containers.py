"""Cameras in JSON and TOML documents: a mapping or a list of cameras, at the top or below other keys."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from humansim_ros.camera.formats.base import CalibrationFile, Key

#: Most keys above the cameras of a file.
_DEPTH = 3
#: Keys of a camera that have its name, in order of precedence.
_NAMES = ("name", "camera_name", "camera", "cam_name", "id", "camera_id", "cam_id", "serial", "serial_number")

Keys = tuple[Key, ...]


def find_cameras(
    file: CalibrationFile, is_camera: Callable[[Any], bool], is_part: Callable[[Any], bool]
) -> list[tuple[str, Keys]]:
    """Find the cameras of a document: their names and key paths, in the order of the file.

    Args:
        file: File that is being read.
        is_camera: Whether a value has all keys of a camera.
        is_part: Whether a value has some of these keys. Where one item is a camera, these are cameras too.

    Returns:
        Cameras; empty if the document has none. Cameras of a list without names have their indices as names.
    """
    if is_camera(file.document):
        return [(_name(file.document, Path(file.path).stem), ())]
    for keys, value in _containers(file.document, (), _DEPTH):
        named = isinstance(value, dict)
        items = list(value.items()) if named else list(enumerate(value))
        if any(is_camera(item) for _, item in items):
            cameras = [(key, item) for key, item in items if is_camera(item) or is_part(item)]
            return [
                (str(key) if named else _name(item, str(key)), (*keys, key if named else int(key)))
                for key, item in cameras
            ]
    return []


def _containers(value: Any, keys: Keys, depth: int) -> Iterator[tuple[Keys, Any]]:
    """Mappings and lists of a document with their key paths, outer ones first."""
    if not isinstance(value, (dict, list)) or depth < 0:
        return
    yield keys, value
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _containers(inner, (*keys, key), depth - 1)


def _name(camera: Any, otherwise: str) -> str:
    """Name of a camera that has no key in a mapping."""
    for key in _NAMES:
        value = camera.get(key)
        if isinstance(value, (str, int)) and not isinstance(value, bool) and str(value).strip():
            return str(value).strip()
    return otherwise


def has_keys(*needed: set[str]) -> Callable[[Any], bool]:
    """Function that tells whether a value is a mapping with a key of each of these sets."""
    return lambda value: isinstance(value, dict) and all(keys & value.keys() for keys in needed)
