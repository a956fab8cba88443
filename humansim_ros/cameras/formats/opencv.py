"""FileStorage files of OpenCV (YAML, XML, JSON), with the keys of OpenCV's samples and of other programs.

A file holds one camera (camera_matrix, distortion_coefficients, R, T), a stereo pair (M1, D1, M2, D2, R, T,
R1, P1 …), or many cameras (K_left, dist_left, Rot_left, T_left, as in EasyMocap). Intrinsics and extrinsics
are in one file, or in two with intri and extri in their names. x_cam = R x + T in the unit of the calibration
board.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.cameras.formats.base import (
    CalibrationFile,
    Key,
    RawCamera,
    find_model,
    json_file,
    nested,
    opencv_model,
    rotation_of,
    row,
    vector_of,
)
from humansim_ros.cameras.formats.lens_keys import model_of_four
from humansim_ros.cameras.formats.spellings import CAMERA_KEYS, Entry, size_of
from humansim_ros.cameras.formats.syntax import Matrix, name_of_half, other_half, read_document
from humansim_ros.cameras.formats.table import calibration_format
from humansim_ros.errors import CameraError
from humansim_ros.types import Array

#: Names of the camera parameters, in order of precedence. Case and underscores are ignored.
_NAMES: dict[str, list[str]] = {part: names.split() for part, names in CAMERA_KEYS["opencv"].items()}
_PARTS = ("K", "distortion", "R", "t", "rectification", "rectified")
#: Parameters that all cameras may share.
_SHARED = ("width", "height", "size", "model", "fisheye")
_SUFFIX = r"(?:_?([0-9]+)|_([A-Za-z0-9_-]+))?"
_NAME = re.compile(r"[A-Za-z0-9_-]+")


def _pattern(names: Sequence[str]) -> re.Pattern[str]:
    longest = sorted(names, key=len, reverse=True)
    return re.compile(f"({'|'.join(n.replace('_', '_?') for n in longest)}){_SUFFIX}", re.IGNORECASE)


_PATTERNS = {part: _pattern(names) for part, names in _NAMES.items()}


_Table = dict[str, dict[str, Entry]]


def _is_storage(file: CalibrationFile) -> bool:
    table = _table([file])
    if file.syntax == "json" and not _is_opencv_json(file, table):
        return False  # plain lists are read by the format of matrices, which knows all their spellings
    return bool(table["K"]) or (bool(table["R"]) and bool(table["t"]))


def _is_opencv_json(file: CalibrationFile, table: _Table) -> bool:
    stereo = {"1", "2"} <= table["K"].keys() and "" in table["R"]
    values = file.document.values() if isinstance(file.document, dict) else ()
    return stereo or any(isinstance(value, Matrix) for value in values)


def _table(files: Sequence[CalibrationFile]) -> _Table:
    """Entries by parameter, then by suffix of the camera name."""
    ranked: dict[str, dict[str, tuple[int, Entry]]] = {part: {} for part in _NAMES}
    for file in files:
        for key in file.document if isinstance(file.document, dict) else ():
            for part, pattern in _PATTERNS.items():
                matched = pattern.fullmatch(str(key))
                value = file.document[key]
                if matched is None or (part in _PARTS and not isinstance(value, (dict, list))):
                    continue
                keys: tuple[Key, ...] = (key, "data") if isinstance(value, dict) else (key,)
                if isinstance(value, dict) and "data" not in value:
                    continue
                name = matched[1].replace("_", "").lower()
                rank = [n.replace("_", "").lower() for n in _NAMES[part]].index(name)
                suffix = matched[2] or matched[3] or ""
                known = ranked[part].get(suffix)
                if known is None or rank < known[0]:
                    ranked[part][suffix] = rank, Entry(file, keys)
    return {part: {s: entry for s, (_, entry) in entries.items()} for part, entries in ranked.items()}


def _read(file: CalibrationFile) -> dict[str, RawCamera]:
    table, stem = _table([file]), Path(file.path).stem
    if not table["K"] or not (table["R"] or table["t"] or table["rectified"]):
        half = other_half(Path(file.path))
        if half is not None:
            stem = name_of_half(stem)
            table = _table([file, read_document(half, 8 << 20)])
    if not table["K"]:
        message = f"the file has no camera matrix; its known names are {', '.join(_NAMES['K'])}"
        raise CameraError(message, path=file.path)
    cameras: dict[str, RawCamera] = {}
    stereo = list(table["K"]) == ["1", "2"] and "" in table["R"] and "" in table["t"]
    for suffix in table["K"]:
        name = suffix or str(file.get("camera_name") or "").strip() or stem
        entries = {part: by_suffix[suffix] for part, by_suffix in table.items() if suffix in by_suffix}
        shared = {part: table[part][""] for part in _SHARED if "" in table[part]}
        file.add(cameras, name, _camera(shared | entries, suffix, stereo, table))
    return cameras


def _camera(entries: Mapping[str, Entry], suffix: str, stereo: bool, table: _Table) -> RawCamera:
    k, rotation, t = entries["K"].numbers(3, 3), entries.get("R"), entries.get("t")
    rectification, rectified = entries.get("rectification"), entries.get("rectified")
    if stereo:
        rectification = rotation or rectification
        rotation, t = (None, None) if suffix == "1" else (table["R"][""], table["t"][""])
    elif rotation is not None and t is None and rectified is not None:
        rotation, rectification = None, rotation  # R is the rectification, as in CameraInfo
    if rotation is None and t is not None:
        raise t.error("needs R as well")
    if rotation is not None and t is None:
        raise rotation.error("needs T as well")
    distortion = entries["distortion"].numbers() if "distortion" in entries else np.zeros(0)
    r = np.eye(3) if stereo else None  # the first camera of a stereo pair is the world
    return RawCamera(
        k,
        r if rotation is None else rotation_of(rotation.file, *rotation.keys),
        np.zeros(3) if t is None else t.numbers(3),
        size=size_of(entries),
        distortion=tuple(distortion),
        model=_model(entries, distortion, k),
        rectification=None if rectification is None else rectification.numbers(3, 3),
        rectified=None if rectified is None else rectified.numbers(3, 4),
        locations={part: entries[part].location for part in _PARTS if part in entries},
    )


def _model(entries: Mapping[str, Entry], distortion: Array, k: Array) -> str | None:
    """Distortion model. OpenCV decides by the number of coefficients, except for fisheyes."""
    lens, name, fisheye = (entries.get(part) for part in ("distortion", "model", "fisheye"))
    word = "" if name is None else name.word
    if word in ("", "pinhole", "perspective", "opencv"):
        bent = None if fisheye is None else fisheye.word not in ("0", "false", "no")
        word = "equidistant" if bent else opencv_model(distortion)
        if lens is not None and len(distortion) == 4:
            word = model_of_four(lens.file, lens.keys, distortion, k, bent)
    if lens is None:
        return None if word != "equidistant" else word
    return find_model(lens.file, word, distortion, (name or fisheye or lens).keys, lens.keys)


# -- writing

_Value = int | str | list[str] | Array


def _entries(cameras: Mapping[str, Camera]) -> dict[str, _Value]:
    """Names and values of all entries. Matrices are arrays (rows, cols)."""
    if len(cameras) == 1:
        ((name, camera),) = cameras.items()
        return {
            "camera_name": name,
            "image_width": camera.size[0],
            "image_height": camera.size[1],
            "camera_matrix": camera.K,
            "distortion_model": str(camera.model),
            "distortion_coefficients": np.array([camera.distortion]),
            "R": camera.R,
            "T": camera.t[:, None],
            **_stereo_entries(camera, ""),
        }
    entries: dict[str, _Value] = {"names": list(cameras)}
    for name, camera in cameras.items():
        if _NAME.fullmatch(name) is None:
            raise CameraError("this format needs a name of letters, digits, _ and -", key=name)
        own: dict[str, _Value] = {
            f"W_{name}": camera.size[0],
            f"H_{name}": camera.size[1],
            f"K_{name}": camera.K,
            f"distortion_model_{name}": str(camera.model),
            f"dist_{name}": np.array([camera.distortion]),
            f"R_{name}": vector_of(camera.R)[:, None],
            f"Rot_{name}": camera.R,
            f"T_{name}": camera.t[:, None],
            **_stereo_entries(camera, f"_{name}"),
        }
        if any(_is_single_camera_key(key) for key in own):
            raise CameraError("this format cannot store a camera of this name", key=name)
        entries |= own
    return entries


def _is_single_camera_key(key: str) -> bool:
    """Whether a reader would take a key, such as dist_coeffs, for a parameter of a single camera."""
    matches = (pattern.fullmatch(key) for pattern in _PATTERNS.values())
    return any(matched and not (matched[2] or matched[3]) for matched in matches)


def _stereo_entries(camera: Camera, suffix: str) -> dict[str, _Value]:
    entries: dict[str, _Value] = {}
    if camera.rectification is not None:
        entries[f"rectification_matrix{suffix}"] = camera.rectification
    if camera.rectified is not None:
        entries[f"projection_matrix{suffix}"] = camera.rectified
    return entries


def _write_yaml(cameras: Mapping[str, Camera]) -> dict[str, str]:
    lines = ["%YAML:1.0", "---"]
    for key, value in _entries(cameras).items():
        if isinstance(value, np.ndarray):
            rows, columns = value.shape
            lines += [f"{key}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d"]
            lines += [f"   data: [ {row(value.ravel(), ', ')} ]"]
        elif isinstance(value, list):
            lines += [f"{key}:", *(f'   - "{item}"' for item in value)]
        else:
            lines.append(f"{key}: {value if isinstance(value, int) else json.dumps(value)}")
    return {"": "\n".join(lines) + "\n"}


def _write_xml(cameras: Mapping[str, Camera]) -> dict[str, str]:
    lines = ['<?xml version="1.0"?>', "<opencv_storage>"]
    for key, value in _entries(cameras).items():
        if isinstance(value, np.ndarray):
            rows, columns = value.shape
            lines += [
                f'<{key} type_id="opencv-matrix">',
                f"  <rows>{rows}</rows>",
                f"  <cols>{columns}</cols>",
            ]
            lines += ["  <dt>d</dt>", "  <data>", f"    {row(value.ravel())}</data></{key}>"]
        elif isinstance(value, list):
            lines += [f"<{key}>", "  " + " ".join(f'"{item}"' for item in value) + f"</{key}>"]
        else:
            lines.append(f"<{key}>{value if isinstance(value, int) else _quoted(value)}</{key}>")
    return {"": "\n".join([*lines, "</opencv_storage>"]) + "\n"}


def _quoted(text: str) -> str:
    if any(c in '<>&"' or not c.isprintable() for c in text):
        raise CameraError("this format cannot store a camera of this name", key=text)
    return f'"{text}"'


def _write_json(cameras: Mapping[str, Camera]) -> dict[str, str]:
    def item(value: _Value) -> Any:
        if not isinstance(value, np.ndarray):
            return value
        rows, columns = value.shape
        data = nested(value.ravel())
        return {"type_id": "opencv-matrix", "rows": rows, "cols": columns, "dt": "d", "data": data}

    return json_file({key: item(value) for key, value in _entries(cameras).items()})


OPENCV = calibration_format("opencv", _is_storage, _read, _write_yaml)
OPENCV_XML = calibration_format("opencv_xml", _is_storage, _read, _write_xml)
OPENCV_JSON = calibration_format("opencv_json", _is_storage, _read, _write_json)
