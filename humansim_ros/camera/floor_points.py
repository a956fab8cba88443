"""Floor points in YAML or JSON files and on the command line, for ``humansim camera place``.

A file has a list ``points``. Each point has ``xyz`` (3 numbers, in the unit and axes of the calibration file)
or ``pixels`` (x, y by name of camera; two or more), and ``map`` (x, y in metres) if its place in the room is
known.
"""

from __future__ import annotations

import os
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field, ValidationError, model_validator

from humansim_ros.camera.placing import FloorPoint
from humansim_ros.errors import CameraError
from humansim_ros.io.schema import Section
from humansim_ros.io.schema_errors import schema_error
from humansim_ros.io.yaml import read_yaml
from humansim_ros.types import Array

_Number = Annotated[float, Field(ge=-1e9, le=1e9)]
#: Name before the colon that stands for a place in ``map``, not for a camera.
_MAP = "map"


class _Point(Section):
    """One floor point of a file."""

    model_config = ConfigDict(coerce_numbers_to_str=True)

    xyz: tuple[_Number, _Number, _Number] | None = None
    pixels: dict[str, tuple[_Number, _Number]] = Field(default_factory=dict)
    map: tuple[_Number, _Number] | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> _Point:
        if (self.xyz is None) == (not self.pixels):
            raise ValueError("needs xyz, or pixels of two cameras or more")
        return self


class _File(Section):
    """Content of a file of floor points."""

    points: tuple[_Point, ...] = Field(min_length=1, max_length=10_000)


def read_floor_points(path: str | os.PathLike[str], in_metres: Array) -> list[FloorPoint]:
    """Read a file of floor points.

    ``in_metres`` (3, 3): from the unit and axes of the calibration file to metres and z up.

    Raises:
        CameraError: The file cannot be read; it has line and key.
    """
    data, tree = read_yaml(path, CameraError, "floor points")
    if not isinstance(data, dict):
        raise CameraError("floor points are a mapping with the list 'points'", path=path)
    try:
        file = _File.model_validate(data)
    except ValidationError as reason:
        raise schema_error(reason, _File, CameraError, path, tree) from None
    return [
        FloorPoint(
            None if point.xyz is None else in_metres @ np.array(point.xyz),
            {name: np.array(pixel) for name, pixel in point.pixels.items()},
            None if point.map is None else np.array(point.map),
        )
        for point in file.points
    ]


def parse_floor_point(text: str, in_metres: Array) -> FloorPoint:
    """Floor point of text such as ``left:312,400 right:280.5,410`` or ``0.1,0.2,3 map:0,1``.

    ``in_metres`` (3, 3): as for :func:`read_floor_points`.

    Raises:
        CameraError: The text is not a floor point.
    """
    xyz, on_map, pixels = None, None, {}
    for word in text.split():
        name, colon, numbers = word.rpartition(":")
        values = _values(numbers, 2 if colon else 3, text)
        if not colon and xyz is None:
            xyz = in_metres @ values
        elif name == _MAP and on_map is None:
            on_map = values
        elif name and name != _MAP and name not in pixels:
            pixels[name] = values
        else:
            raise CameraError(f"{word!r} is repeated, or has no name", key="--floor-point")
    if (xyz is None) == (not pixels):
        hint = (
            "use 'left:312,400 right:280.5,410' (pixels of cameras) or '0.1,0.2,3' (in the world of the file)"
        )
        raise CameraError(f"{text!r} is not a floor point: {hint}", key="--floor-point")
    return FloorPoint(xyz, pixels, on_map)


def _values(text: str, count: int, point: str) -> Array:
    try:
        values = np.array([float(word) for word in text.split(",")])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        message = f"{point!r}: needs {count} numbers with commas between them, not {text[:40]!r}"
        raise CameraError(message, key="--floor-point")
    return values
