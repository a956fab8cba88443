"""Table of the calibration formats: their names, units and what they store, and the functions of each.

``config/calibration_formats.json`` has a row for each format; its keys are fields of
:class:`CalibrationFormat`, which tells their defaults. A module of the family of the format adds its
functions with :func:`calibration_format`.

``written`` of a row is the content of a file in JSON, or of XML as attributes and lists of elements by their
tag. ``$fx`` is the value of a camera of this name (:func:`_values`, and the values of the format), or its
digits within a longer text. What is below the key ``$each`` is written for each camera in a list, below
``$name`` for each camera under its name. A key whose value a camera does not have is left out. ``names`` is
``words`` or ``printable``: the names that can be written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from string import Template
from typing import Any

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import (
    OPENGL,
    CalibrationFile,
    RawCamera,
    check_names,
    json_file,
    nested,
    text_of,
    xml_file,
)
from humansim_ros.camera.lens import MODELS
from humansim_ros.geometry import matrix_to_quaternion
from humansim_ros.io.assets import read_table
from humansim_ros.types import ImageSize

_ROWS: Mapping[str, dict[str, Any]] = read_table("calibration_formats")


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


#: Values of a camera in a template, by their names.
Values = Mapping[str, Any]


def calibration_format(
    name: str,
    matches: Callable[[CalibrationFile], bool],
    read: Callable[[CalibrationFile], dict[str, RawCamera]],
    write: Callable[[Mapping[str, Camera]], Mapping[str, str | bytes]] | None = None,
    find_unit: Callable[[CalibrationFile, Mapping[str, RawCamera]], float] | None = None,
    values: Callable[[Values, Camera], Values] = lambda own, camera: {},
) -> CalibrationFormat:
    """Format of a row of the table.

    Args:
        name: Name of the format; ``matches``, ``read``, ``write`` and ``find_unit`` are as of
            :class:`CalibrationFormat`.
        matches: Whether a file has this format.
        read: Cameras of a file.
        write: Files of cameras. Without it, the row has a template.
        find_unit: Metres per unit.
        values: Values of a camera that only this template has, from its other values.
    """
    row: Any = {key: _tuples(value) for key, value in _ROWS[name].items()}
    template, names = row.pop("written", None), row.pop("names", "")

    def write_template(cameras: Mapping[str, Camera]) -> Mapping[str, str | bytes]:
        if names:
            check_names(cameras, words=names == "words")
        each = []
        for index, (name, camera) in enumerate(cameras.items()):
            own = _values(name, index, camera)
            each.append({**own, **values(own, camera)})
        fisheyes = all(camera.model == "equidistant" for camera in cameras.values()) or None
        content = _filled(template, each, {"count": len(each), "all_fisheye": fisheyes})
        return json_file(content) if row["syntax"] == "json" else xml_file(content)

    write = write or write_template
    return CalibrationFormat(name, matches=matches, read=read, write=write, find_unit=find_unit, **row)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _values(name: str, index: int, camera: Camera) -> dict[str, Any]:
    """Values of a camera that templates may have.

    Besides the intrinsics: ``K``, ``R``, ``Rt``, ``w2c``, ``c2w`` (camera to world) and ``gl`` (the same with
    the camera axes of OpenGL: y up, z backward), with ``_flat`` in row order, with ``_columns`` in column
    order, and numbers of R and gl by row and column (``R12``); ``t`` and ``center``, also as ``_column``.
    """
    (width, height), k = camera.size, camera.K
    own = dict(zip(MODELS[str(camera.model)], camera.distortion, strict=True))
    c2w, w2c = camera.world_from_optical, camera.optical_from_world
    matrices = {"K": k, "R": camera.R, "Rt": w2c[:3], "w2c": w2c, "c2w": c2w, "gl": c2w @ OPENGL}
    vectors = {"t": camera.t, "center": camera.center, "distortion": np.array(camera.distortion)}
    return {
        "name": name,
        "image": f"{name}.png",
        "index": index,
        "number": index + 1,
        "size": list(camera.size),
        "width": width,
        "height": height,
        "model": str(camera.model),
        "fx": k[0, 0],
        "fy": k[1, 1],
        "cx": k[0, 2],
        "cy": k[1, 2],
        "skew": k[0, 1],
        "cx_corner": k[0, 2] + 0.5,
        "cy_corner": k[1, 2] + 0.5,
        "aspect": k[0, 0] / k[1, 1],
        **{key: nested(value) for key, value in {**matrices, **vectors}.items()},
        **{f"{key}_flat": nested(matrix.ravel()) for key, matrix in matrices.items()},
        **{f"{key}_columns": nested(matrix.T.ravel()) for key, matrix in matrices.items()},
        **{f"{key}_column": nested(vector[:, None]) for key, vector in vectors.items()},
        **{f"{m}{i + 1}{j + 1}": matrices[m][i, j] for m in ("R", "gl") for i in range(3) for j in range(3)},
        "quaternion": nested(matrix_to_quaternion(camera.R)),
        **own,
        **dict(zip(("t1", "t2", "t3", "x", "y", "z"), (*camera.t, *camera.center), strict=True)),
    }


def _filled(template: Any, each: Sequence[Values], values: Values) -> Any:
    """Template with ``values``, or the values of ``each`` camera; None if it has only missing values."""
    if isinstance(template, str):
        if "$" not in template:
            return template
        if template[1:].isidentifier():
            return values.get(template[1:])
        return Template(template).substitute({key: text_of(value) for key, value in values.items()})
    if isinstance(template, Mapping):
        if "$each" in template:
            return [_filled(template["$each"], each, one) for one in each]
        if "$name" in template:
            return {one["name"]: _filled(template["$name"], each, one) for one in each}
        items = {key: _filled(value, each, values) for key, value in template.items()}
        return {key: value for key, value in items.items() if value is not None} or None
    if isinstance(template, list):
        filled = [item for below in template if (item := _filled(below, each, values)) is not None]
        return filled if filled or not template else None
    return template
