"""ROS camera_info: YAML files as camera_calibration writes them, printed messages, and the older INI form.

Everything is named and ordered as in ROS's camera_calibration_parsers; neither form holds extrinsics.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import (
    CalibrationFormat,
    CalibrationSource,
    FilePosition,
    Key,
    RawCamera,
    row,
)
from humansim_ros.camera.formats.models import COUNTS, lens_of
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.types import Array

_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_/-]*")
#: What YAML would not read as text again.
_WORDS = {"yes", "no", "on", "off", "true", "false", "null", "y", "n"}
#: Parts of a camera, and where they are in a file and in a message.
_IN_FILE: dict[str, tuple[Key, ...]] = {
    "size": ("image_width",),
    "K": ("camera_matrix", "data"),
    "distortion": ("distortion_coefficients", "data"),
    "model": ("distortion_model",),
    "rectification": ("rectification_matrix", "data"),
    "rectified": ("projection_matrix", "data"),
}
_IN_MESSAGE = {
    "K": "k",
    "distortion": "d",
    "model": "distortion_model",
    "rectification": "r",
    "rectified": "p",
}


def _is_camera_info(source: CalibrationSource) -> bool:
    # OpenCV's matrices are read as dictionaries of a type of their own
    of_file = type(source.get("camera_matrix")) is dict and "image_width" in source.document
    return of_file or _is_message(source)


def _is_message(source: CalibrationSource) -> bool:
    keys = source.document if isinstance(source.document, dict) else {}
    return {"height", "width", "distortion_model", "k", "p"} <= {str(key).lower() for key in keys}


def _read_camera_info(source: CalibrationSource) -> dict[str, RawCamera]:
    if _is_message(source):
        return _read_message(source)
    size = source.size(("image_width",), ("image_height",))
    if source.get("distortion_coefficients", "data") is None:  # a file that was cut off is no ideal camera
        raise source.error("is missing; a camera without distortion has zeros", "distortion_coefficients")
    name = str(source.get("camera_name") or "").strip()
    return {name or Path(source.path).stem: _camera(source, size, _IN_FILE)}


def _read_message(source: CalibrationSource) -> dict[str, RawCamera]:
    """What ``ros2 topic echo`` prints; in ROS 1 the names of matrices are in capitals."""
    spelt = {str(key).lower(): key for key in source.document}
    keys: dict[str, tuple[Key, ...]] = {part: (spelt.get(k, k),) for part, k in _IN_MESSAGE.items()}
    camera = _camera(source, source.size((spelt["width"],), (spelt["height"],)), keys)
    parts = ("x_offset", "y_offset", "height", "width")
    binned = any(source.get(key) not in (None, 0, 1) for key in ("binning_x", "binning_y"))
    if binned or any(source.get("roi", part) for part in parts):
        warn_about(
            source.path, "binning and region of interest are left out: the camera is of the full image"
        )
    frame = str(source.get("header", "frame_id") or "").strip()
    return {frame.removesuffix("_optical_frame") or Path(source.path).stem: camera}


def _camera(
    source: CalibrationSource, size: tuple[int, int], keys: Mapping[str, tuple[Key, ...]]
) -> RawCamera:
    k = source.numbers((3, 3), *keys["K"])
    if not k.any():
        raise source.error("is all zeros, which is how ROS says 'not calibrated'", *keys["K"])
    given = source.get(*keys["distortion"])
    distortion = np.zeros(0) if given in (None, []) else source.some_numbers(*keys["distortion"])
    return RawCamera(
        k,
        size=size,
        distortion=tuple(distortion),
        model=lens_of(source, source.get(*keys["model"]), distortion, keys["model"], keys["distortion"]),
        rectification=_matrix(source, (3, 3), keys["rectification"]),
        rectified=_matrix(source, (3, 4), keys["rectified"]),
        places={part: source.place(*path) for part, path in keys.items()},
    )


def _matrix(source: CalibrationSource, shape: tuple[int, ...], keys: tuple[Key, ...]) -> Array | None:
    """A matrix that may be missing, or be all zeros, as from drivers that do not rectify."""
    if source.get(*keys) is None:
        return None
    matrix = source.numbers(shape, *keys)
    return matrix if matrix.any() else None


def _write_camera_info(cameras: Mapping[str, Camera]) -> dict[str, str]:
    ((name, camera),) = cameras.items()
    plain = _PLAIN.fullmatch(name) and name.lower() not in _WORDS
    lines = [
        f"image_width: {camera.size[0]}",
        f"image_height: {camera.size[1]}",
        f"camera_name: {name if plain else json.dumps(name)}",
        *_matrix_lines("camera_matrix", camera.K),
        f"distortion_model: {camera.model}",
        *_matrix_lines("distortion_coefficients", np.array([camera.distortion])),
        *_matrix_lines("rectification_matrix", camera.rectification_matrix),
        *_matrix_lines("projection_matrix", camera.rectified_projection),
    ]
    return {"": "\n".join(lines) + "\n"}


def _matrix_lines(key: str, matrix: Array) -> list[str]:
    rows, columns = matrix.shape
    return [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{row(matrix.ravel(), ', ')}]"]


# -- INI, of Videre's software: a key on a line of its own, its numbers on the lines below

_INI_SHAPES = {"camera matrix": (3, 3), "rectification": (3, 3), "projection": (3, 4)}
#: Sections that describe no camera. ROS reads and forgets the second.
_IMAGE, _EXTERNALS = "image", "externals"
_MAX_NUMBERS = 50
_HEADING = re.compile(r"\[(.*)\]")


def _is_ini(source: CalibrationSource) -> bool:
    first = next(iter(source.head), "")
    return _HEADING.fullmatch(first) is not None and any(c.isalpha() for c in first)


def _read_ini(source: CalibrationSource) -> dict[str, RawCamera]:
    sections = _sections(source)
    size = tuple(_whole(source, sections, key) for key in ("width", "height"))
    cameras: dict[str, RawCamera] = {}
    for name, (line, section) in sections.items():
        if name not in (_IMAGE, _EXTERNALS):
            camera = _ini_camera(source, name, line, section, (size[0], size[1]))
            source.add(cameras, name or Path(source.path).stem, camera, line=line)
    if not cameras:
        raise CameraError("there is no section of a camera, such as [narrow_stereo]", path=source.path)
    return cameras


_Section = dict[str, tuple[int, list[float]]]


def _sections(source: CalibrationSource) -> dict[str, tuple[int, _Section]]:
    """Sections by name: the line of each, and its keys with their lines and numbers."""
    sections: dict[str, tuple[int, _Section]] = {}
    section: _Section = {}
    values: list[float] | None = None
    for number, line in source.lines():
        heading = _HEADING.fullmatch(line)
        if heading:
            name, section, values = heading[1].strip(), {}, None
            if name in sections:
                raise CameraError(
                    "this section is here a second time", path=source.path, line=number, key=name
                )
            sections[name] = number, section
        elif any(c.isalpha() for c in line.split()[0]) and line.split()[0].lower() not in ("nan", "inf"):
            values = []
            if line in section:
                raise CameraError("this key is here a second time", path=source.path, line=number, key=line)
            section[line] = number, values
        elif values is None:
            raise CameraError("numbers without a key above them", path=source.path, line=number)
        else:
            values += source.row(line.split(), number)
            if len(values) > _MAX_NUMBERS:
                raise CameraError(f"more than {_MAX_NUMBERS} numbers of a key", path=source.path, line=number)
    return sections


def _whole(source: CalibrationSource, sections: Mapping[str, tuple[int, _Section]], key: str) -> int:
    line, values = _found(source, sections.get(_IMAGE, (None, {}))[1], _IMAGE, key)
    if len(values) != 1 or values[0] != int(values[0]) or values[0] <= 0:
        raise CameraError("needs a whole number above zero", path=source.path, line=line, key=key)
    return int(values[0])


def _found(source: CalibrationSource, section: _Section, name: str, key: str) -> tuple[int, list[float]]:
    if key not in section:
        raise CameraError(f"is missing in section [{name}]", path=source.path, key=key)
    return section[key]


def _ini_camera(
    source: CalibrationSource, name: str, line: int, section: _Section, size: tuple[int, int]
) -> RawCamera:
    matrices, places = {}, {"": FilePosition(name, line)}
    for key, shape in _INI_SHAPES.items():
        at, values = _found(source, section, name, key)
        if len(values) != shape[0] * shape[1]:
            message = f"needs {shape[0]} x {shape[1]} numbers, not {len(values)}"
            raise CameraError(message, path=source.path, line=at, key=key)
        matrices[key], places[key] = np.reshape(values, shape), FilePosition(key, at)
    at, distortion = _found(source, section, name, "distortion")
    if len(distortion) not in (4, 5, 8):
        message = f"needs 5 coefficients (plumb_bob) or 8 (rational_polynomial), not {len(distortion)}"
        raise CameraError(message, path=source.path, line=at, key="distortion")
    return RawCamera(
        matrices["camera matrix"],
        size=size,
        distortion=tuple(distortion),
        model="rational_polynomial" if len(distortion) == 8 else "plumb_bob",
        rectification=matrices["rectification"],
        rectified=matrices["projection"],
        places={
            "": places[""],
            "K": places["camera matrix"],
            "distortion": FilePosition("distortion", at),
            "rectification": places["rectification"],
            "rectified": places["projection"],
        },
    )


def _write_ini(cameras: Mapping[str, Camera]) -> dict[str, str]:
    ((name, camera),) = cameras.items()
    if name in (_IMAGE, _EXTERNALS) or any(c in "[]\n\r" for c in name) or not name.strip():
        raise CameraError("this form cannot hold a camera of this name", key=name)
    parts: dict[str, Any] = {
        "camera matrix": camera.K,
        "distortion": np.array([camera.distortion]),
        "rectification": camera.rectification_matrix,
        "projection": camera.rectified_projection,
    }
    lines = ["# Camera intrinsics", "", "[image]", "", "width", str(camera.size[0]), ""]
    lines += ["height", str(camera.size[1]), "", f"[{name}]"]
    for key, matrix in parts.items():
        lines += ["", key, *(row(values) for values in matrix)]
    return {"": "\n".join(lines) + "\n"}


CAMERA_INFO = CalibrationFormat(
    "camera_info",
    "ROS camera_info YAML",
    ".yaml",
    "yaml",
    _is_camera_info,
    _read_camera_info,
    _write_camera_info,
    several=False,
    holds_pose=False,
    holds_rectified=True,
    lenses=COUNTS,
)
INI = CalibrationFormat(
    "ini",
    "ROS camera_info INI",
    ".ini",
    "text",
    _is_ini,
    _read_ini,
    _write_ini,
    several=False,
    holds_pose=False,
    holds_rectified=True,
    lenses={"plumb_bob": 5, "rational_polynomial": 8},
)
