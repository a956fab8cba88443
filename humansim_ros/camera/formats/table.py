"""Table of the calibration formats: their names, units and what they store, and the functions of each.

``config/calibration_formats.json`` has a row for each format; its keys are fields of
:class:`CalibrationFormat`, which tells their defaults. A module of the family of the format adds its
functions with :func:`calibration_format`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import CalibrationFile, RawCamera
from humansim_ros.io.assets import resource_path
from humansim_ros.types import ImageSize

_ROWS: Mapping[str, dict[str, Any]] = json.loads(resource_path("config/calibration_formats.json").read_text())


@dataclass(frozen=True)
class CalibrationFormat:
    """A calibration format.

    Attributes:
        name: Name on the command line.
        title: Name in messages.
        suffix: Suffix of its files.
        syntax: ``text``, ``yaml``, ``json``, ``toml``, ``xml`` or ``npz``.
        matches: Whether a file of this syntax has this format.
        read: Cameras of a file by name.
        write: Content of each file by its name; a format of one file has the name "".
        multiple: Whether a file holds more than one camera.
        unit: Metres per unit of the file.
        up: Axis of its world that points up.
        holds_size, holds_pose, holds_skew, holds_rectified: Parts of a camera that it can store.
        lenses: Distortion models that it can store, and the number of their coefficients.
        sizes: Usual image sizes of a format that does not store the size.
        find_unit: Finds the metres per unit of a file, where the format does not define them.
        also: Other syntaxes from which it is read, after all of their own formats.
    """

    name: str
    title: str
    suffix: str
    syntax: str
    matches: Callable[[CalibrationFile], bool]
    read: Callable[[CalibrationFile], dict[str, RawCamera]]
    write: Callable[[Mapping[str, Camera]], Mapping[str, str | bytes]]
    multiple: bool = True
    unit: float = 1.0
    up: str = "z"
    holds_size: bool = True
    holds_pose: bool = True
    holds_skew: bool = True
    holds_rectified: bool = False
    lenses: Mapping[str, int] = field(default_factory=dict)
    sizes: tuple[ImageSize, ...] = ()
    find_unit: Callable[[CalibrationFile, Mapping[str, RawCamera]], float] | None = None
    also: tuple[str, ...] = ()


def calibration_format(
    name: str,
    matches: Callable[[CalibrationFile], bool],
    read: Callable[[CalibrationFile], dict[str, RawCamera]],
    write: Callable[[Mapping[str, Camera]], Mapping[str, str | bytes]],
    find_unit: Callable[[CalibrationFile, Mapping[str, RawCamera]], float] | None = None,
) -> CalibrationFormat:
    """Format of a row of the table. Arguments as the fields of :class:`CalibrationFormat`."""
    row: Any = {key: _tuples(value) for key, value in _ROWS[name].items()}
    return CalibrationFormat(name, matches=matches, read=read, write=write, find_unit=find_unit, **row)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
