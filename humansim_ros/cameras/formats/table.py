"""Table of the calibration formats: their names, units, keys and what they store.

``config/calibration_formats.json`` has a row for each format, in the order in which they are tried. The keys
of a row are fields of :class:`CalibrationFormat`, which has their defaults; a row without ``suffix`` is only
read. The other keys say how a file is read and written. Where they do not suffice, the module of the format's
family adds functions with :func:`calibration_format`.

``known`` are patterns of keys that a file has; for plain text, patterns of path and text. ``only``: all keys
of camera parameters that a file may have. ``needs``: keys that each camera must have, with | between keys
that replace each other. ``shared``: values of all cameras that do not have their own. ``renamed``: by pattern
of a key, its name here, with ' for a matrix in column order, or "" to leave the key out; a pattern with =
matches a key and its value. ``direction`` of R and t, if their keys do not state it. If a row has no ``unit``
(metres), the file or the extent of the rig decides.

``written`` of a row is a template: the content of a JSON or YAML file; that of an XML file as attributes and
lists of elements by tag; or the lines of a text. ``$fx`` is replaced by the value ``fx`` of a camera
(:func:`_values`, and the values of the format); in a longer text, by its digits. The content of the key
``$each`` is written once for each camera, as a list; the content of ``$name`` once for each camera, under its
name. A key is left out if the camera has no value for it. ``names`` is ``words`` or ``printable``: the names
that can be written.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from itertools import chain
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, indent, tostring

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.cameras.camera.lens import MODELS
from humansim_ros.cameras.formats.base import OPENGL, CalibrationFile, RawCamera
from humansim_ros.cameras.formats.conventions import find_unit
from humansim_ros.cameras.formats.matrices import read_matrices
from humansim_ros.cameras.formats.spellings import (
    check_counts,
    is_camera,
    keys_of,
    plain,
    role_of,
    unit_of_keys,
    words,
)
from humansim_ros.errors import CameraError
from humansim_ros.files.reading import read_table
from humansim_ros.geometry import matrix_to_quaternion
from humansim_ros.types import Array, ImageSize

ROWS: Mapping[str, dict[str, Any]] = read_table("calibration_formats")
#: Cameras by name, or in a list. Each is a mapping of keys. There may also be values of all cameras.
Cameras = dict[str, Any] | list[dict[str, Any]]
#: Names of the parameters of each lens with a name that does not list them.
_LENSES = {"KannalaBrandtK3": "fx_fy_cx_cy_kb4", "Linear": "fx_fy_cx_cy"}
#: Roles of keys that any file may have: none, or the name of a camera.
_NAMED = (None, "name", "names")
_HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


@dataclass(frozen=True)
class CalibrationFormat:
    """A calibration format.

    Attributes:
        name: Name on the command line.
        title: Name in messages.
        syntax: ``text``, ``yaml``, ``json``, ``toml``, ``xml`` or ``npz``.
        matches: Function that tells whether a file of this syntax has this format.
        read: Function that returns the cameras of a file by name.
        write: Function that returns the content of each file by file name. A single file has the name "".
        suffix: Suffix of its files.
        multiple: Whether a file holds more than one camera.
        unit: Metres per unit of the file.
        up: Axis of its world that points up.
        holds_size, holds_pose, holds_skew, holds_rectified: Whether the format can store these values of a
            camera.
        lenses: Distortion models that the format can store, with the number of their coefficients.
        sizes: Usual image sizes of a format that does not store the size.
        find_unit: Function that finds the metres per unit of a file, if the format does not define the unit.
        also: Other syntaxes in which the format can be read. It is tried after the formats of that syntax.
    """

    name: str
    title: str
    syntax: str
    matches: Callable[[CalibrationFile], bool]
    read: Callable[[CalibrationFile], dict[str, RawCamera]]
    write: Callable[[Mapping[str, Camera]], Mapping[str, str | bytes]]
    suffix: str = ""
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


#: Values of a camera for a template, by name.
Values = Mapping[str, Any]


_FIELDS = {one.name for one in fields(CalibrationFormat)}
_Matches = Callable[[CalibrationFile], bool]
_Read = Callable[[CalibrationFile], dict[str, RawCamera]]


def calibration_format(
    name: str,
    matches: _Matches | None = None,
    read: _Read | None = None,
    write: Callable[[Mapping[str, Camera]], Mapping[str, str | bytes]] | None = None,
    *,
    arrange: Callable[[CalibrationFile], Cameras] | None = None,
    find_unit: Callable[[CalibrationFile, Mapping[str, RawCamera]], float] | None = None,
    values: Callable[[Values, Camera], Values] = lambda own, camera: {},
) -> CalibrationFormat:
    """Create a format from a row of the table.

    Args:
        name: Name of the format. ``matches``, ``read``, ``write`` and ``find_unit``: see
            :class:`CalibrationFormat`.
        matches: Whether a file has this format. If None, the row has patterns of its keys.
        read: Cameras of a file. If None, they are read by their keys.
        write: Files of cameras. If None, the row has a template.
        arrange: Makes mappings of keys of the cameras of a file, if they are something else there.
        find_unit: Metres per unit.
        values: Computes values that only this template needs from the other values of a camera.
    """
    row = ROWS[name]
    if read is None:
        read = reader(row, arrange)
        find_unit = find_unit or (None if "unit" in row else unit_of_file)
    return CalibrationFormat(
        name,
        matches=matches or _matcher(row),
        read=read,
        write=write or _writer(row, values),
        find_unit=find_unit,
        **{key: _tuples(value) for key, value in row.items() if key in _FIELDS},
    )


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


# -- reading by keys


def _matcher(row: Mapping[str, Any]) -> _Matches:
    """Make the function ``matches`` of a row."""

    def matches(file: CalibrationFile) -> bool:
        if file.syntax == "text":
            text = f"{file.path}\n{file.text[: 1 << 16]}"
            return all(re.search(one, text, re.MULTILINE) for one in row["known"])
        keys = keys_of(file)
        names = {key for key in keys if is_camera(file.get(key))}
        if "only" in row and any(role_of(key) not in _NAMED for key in keys - names - words(row["only"])):
            return False
        return all(any(re.fullmatch(one, key) for key in keys) for one in row["known"])

    return matches


def reader(
    row: Mapping[str, Any],
    arrange: Callable[[CalibrationFile], Cameras] | None = None,
    others: bool = False,
) -> Callable[..., dict[str, RawCamera]]:
    """Make the function ``read`` of a row. It reads a file, or one with intrinsics and one with extrinsics.
    ``others``: whether keys of parameters may have values of something else."""
    renamed: Mapping[str, str] = row.get("renamed", {})

    def document_of(file: CalibrationFile) -> CalibrationFile:
        back: dict[str, str] = {}

        def rewrite(items: dict[Any, Any]) -> dict[Any, Any]:
            result: dict[Any, Any] = {}
            for key, value in items.items():
                texts = str(key), f"{key}={value}" if isinstance(value, (str, int, float)) else ""
                rules = {} if is_camera(value) and role_of(key) else renamed  # k may be a camera
                found = ((re.fullmatch(one, texts["=" in one]), new) for one, new in rules.items())
                match, new = next(((match, new) for match, new in found if match), (None, ""))
                here = key if match is None else match.expand(new.rstrip("'"))
                back.setdefault(str(here), str(key))
                if here != "":
                    result[here] = _transposed(value) if new.endswith("'") else value
            return _with_params(file, result, back.get("model", "model"))

        arranged = file if arrange is None else replace(file, document=arrange(file))
        found = plain(arranged, rewrite, 1)
        cameras = found.document if isinstance(found.document, dict) else {"cameras": found.document}
        stated = {"convention": row.get("direction", "w2c"), **row.get("shared", {}), **cameras}
        file = replace(file, document=stated, renamed={**back, **found.renamed})
        if not others:
            check_counts(file)
        return file

    def read(file: CalibrationFile, other: CalibrationFile | None = None) -> dict[str, RawCamera]:
        document = document_of(file)
        posed = None if other is None else document_of(other)
        cameras = read_matrices(document, posed, row.get("needs", ()))
        if document.get("origin") == "corner":
            cameras = {name: replace(c, K=c.K - _HALF_PIXEL) for name, c in cameras.items()}
        path = Path(file.path)
        return {path.parent.name: cameras[path.stem]} if [*cameras] == [path.stem] == ["sensor"] else cameras

    return read


def _with_params(file: CalibrationFile, items: dict[Any, Any], key: str) -> dict[Any, Any]:
    """Give each number of ``params`` a key, which depends on the lens. ``key``: key of the lens, for
    errors."""
    if "params" not in items:
        return items
    model, numbers = str(items.get("model")), replace(file, document=items).some_numbers("params").tolist()
    names = _LENSES.get(model, model.removeprefix("calibu_")).replace("kb4", "k1_k2_k3_k4").split("_")
    if len(names) != len(numbers) or not {*names} <= words("f fu fv u0 v0 fx fy cx cy k1 k2 k3 k4"):
        message = f"the lens {model[:60]!r} with {len(numbers)} numbers is not supported"
        raise CameraError(message, path=file.path, key=key)
    values = {"params": None, "model": "none", "fisheye": "k4" in names}
    return items | values | dict(zip(names, numbers, strict=True))


def _transposed(value: Any) -> Any:
    """Transpose a square matrix in column order. A matrix of OpenCV has its numbers under ``data``."""
    if isinstance(value, Mapping):
        return {**value, "data": _transposed(value.get("data"))}
    numbers = np.array(value, dtype=object).ravel()
    side = int(len(numbers) ** 0.5)
    return numbers.reshape(side, side).T.tolist() if side * side == len(numbers) else value


def unit_of_file(file: CalibrationFile, cameras: Mapping[str, RawCamera]) -> float:
    """Metres per unit of a file: from its keys, such as ``translation_mm``, or from :func:`find_unit`."""
    return unit_of_keys(file) or find_unit(file, cameras)


# -- writing


def _writer(
    row: Mapping[str, Any], values: Callable[[Values, Camera], Values]
) -> Callable[[Mapping[str, Camera]], Mapping[str, str | bytes]]:
    """Make the function ``write`` of a row, which has a template."""
    names = row.get("names", "")

    def write(cameras: Mapping[str, Camera]) -> Mapping[str, str | bytes]:
        if names:
            check_names(cameras, words=names == "words")
        each = []
        for index, (name, camera) in enumerate(cameras.items()):
            own = _values(name, index, camera)
            each.append({**own, **values(own, camera)})
        fisheyes = all(camera.model == "equidistant" for camera in cameras.values()) or None
        shared = {**(each[0] if len(each) == 1 else {}), "count": len(each), "all_fisheye": fisheyes}
        return _FILES.get(row["syntax"], text_file)(_filled(row["written"], each, shared))

    return write


def _values(name: str, index: int, camera: Camera) -> dict[str, Any]:
    """Values of a camera that templates may use.

    Matrices are ``K``, ``R``, ``Rt``, ``w2c``, ``c2w`` (camera to world) and ``gl`` (like ``c2w`` with the
    camera axes of OpenGL: y up, z backward). A name may end in ``_flat`` (numbers in row order), ``_columns``
    (in column order), ``_lines`` (a line for each row) or ``_list`` (numbers with commas).
    Single numbers of R and gl have row and column in their names (``R12``). Vectors are ``t`` and ``center``,
    also with the end ``_column``.
    """
    (width, height), k = camera.size, camera.K
    own = dict(zip(MODELS[str(camera.model)], camera.distortion, strict=True))
    c2w, w2c = camera.world_from_optical, camera.optical_from_world
    matrices = {
        "K": k,
        "R": camera.R,
        "Rt": w2c[:3],
        "w2c": w2c,
        "c2w": c2w,
        "gl": c2w @ OPENGL,
        "P": camera.P,
    }
    matrices |= {"rectification": camera.rectification_matrix, "projection": camera.rectified_projection}
    vectors = {"t": camera.t, "center": camera.center, "distortion": np.array(camera.distortion)}
    vectors["rvec"] = Rotation.from_matrix(camera.R).as_rotvec()
    return {
        "name": name,
        "image": f"{name}.png",
        "coefficients": len(camera.distortion),
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
        **{f"{key}_lines": "\n".join(map(row, matrix)) for key, matrix in matrices.items()},
        **{f"{key}_list": row(matrix.ravel(), ", ") for key, matrix in {**matrices, **vectors}.items()},
        "K_rows": ", ".join(f"[{row(values, ', ')}]" for values in k),
        **{f"{key}_column": nested(vector[:, None]) for key, vector in vectors.items()},
        **{f"{m}{i + 1}{j + 1}": matrices[m][i, j] for m in ("R", "gl") for i in range(3) for j in range(3)},
        "quaternion": nested(matrix_to_quaternion(camera.R)),
        **own,
        **dict(zip(("t1", "t2", "t3", "x", "y", "z"), (*camera.t, *camera.center), strict=True)),
    }


def _filled(template: Any, each: Sequence[Values], values: Values) -> Any:
    """Fill a template with ``values``, or with those of ``each`` camera. Returns None if all values are
    missing."""
    if isinstance(template, str):
        if "$" not in template:
            return template
        if template[1:].isidentifier():
            return values.get(template[1:])
        return re.sub(r"\$(\w+)|\$\{(\w+)\}", lambda m: text_of(values[m[1] or m[2]]), template)
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


# -- texts of files


def number(value: float) -> str:
    """Shortest text that reads back as the same number."""
    return repr(float(value) + 0.0)  # adding 0.0 turns -0.0 into 0.0


def row(values: Iterable[float], between: str = " ") -> str:
    """Text of numbers on one line."""
    return between.join(number(v) for v in values)


def nested(matrix: Array | Sequence[float]) -> list[Any]:
    """Nested lists of a matrix for JSON. -0.0 becomes 0.0."""
    return (np.asarray(matrix, dtype=float) + 0.0).tolist()


def text_file(content: list[Any]) -> dict[str, str]:
    """Texts by file name, for a format that consists of one text. ``content``: lines, or lists of the
    lines of each camera."""
    lines: list[Any] = []
    for one in content:
        lines += chain.from_iterable(one) if isinstance(one, list) and isinstance(one[0], list) else [one]
    return {"": "\n".join(map(text_of, lines)) + "\n"}


def text_of(value: Any) -> str:
    """Convert to text: a number, or a list of numbers with blanks between them. A text is unchanged."""
    if isinstance(value, list):
        return " ".join(map(text_of, value))
    return number(value) if isinstance(value, float) else str(value)


def json_file(content: Any) -> dict[str, str]:
    """Texts by file name, for a format that consists of one JSON file."""
    return {"": json.dumps(content, indent=1) + "\n"}


def yaml_file(content: Any) -> dict[str, str]:
    """Texts by file name, for a format that consists of one YAML file. ``content``: lines, or a mapping."""
    if isinstance(content, list):
        return text_file(content)
    text = yaml.safe_dump(
        content, sort_keys=False, default_flow_style=None, allow_unicode=True, width=1 << 30
    )
    return {"": text}


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


_FILES: Mapping[str, Callable[[Any], dict[str, str]]] = {
    "json": json_file,
    "xml": xml_file,
    "yaml": yaml_file,
}
