"""OpenCV's FileStorage (YAML, XML, JSON), under the names that its samples and others give to things.

One camera (camera_matrix, distortion_coefficients, R, T), a stereo pair (M1, D1, M2, D2, R, T, R1, P1 …), or
many (K_left, dist_left, Rot_left, T_left, as in EasyMocap), with intrinsics and extrinsics in one file or in
two that differ by intri and extri in their names. x_cam = R x + T, in the unit of the calibration board.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import (
    CalibrationFormat,
    CalibrationSource,
    FilePosition,
    Key,
    RawCamera,
    number,
    row,
)
from humansim_ros.camera.formats.containers import container_of, parsed
from humansim_ros.camera.formats.models import COUNTS, lens_of
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.io.files import read_text
from humansim_ros.types import Array

#: What parts of a camera are called, case and underscores apart; the first that is there counts.
_NAMES = {
    "K": ("camera_matrix", "intrinsic_matrix", "intrinsics", "intrinsic", "mtx", "K", "M"),
    "distortion": (
        *("distortion_coefficients", "distortion_coeffs", "dist_coeffs", "dist_coefs", "dist_coef"),
        *("distortion", "dist", "D"),
    ),
    "R": ("rotation_matrix", "rotation", "rot", "rvec", "R"),
    "t": ("translation_vector", "translation", "tvec", "T"),
    "rectification": ("rectification_matrix",),
    "rectified": ("projection_matrix", "P"),
    "width": ("image_width", "width", "W"),
    "height": ("image_height", "height", "H"),
    "size": ("image_size", "resolution", "size"),
    "model": ("distortion_model", "camera_model", "model"),
    "fisheye": ("fisheye_model", "fisheye"),
}
_PARTS = ("K", "distortion", "R", "t", "rectification", "rectified")
_SUFFIX = r"(?:_?([0-9]+)|_([A-Za-z0-9_-]+))?"
_NAME = re.compile(r"[A-Za-z0-9_-]+")


def _pattern(names: Sequence[str]) -> re.Pattern[str]:
    longest = sorted(names, key=len, reverse=True)
    return re.compile(f"({'|'.join(n.replace('_', '_?') for n in longest)}){_SUFFIX}", re.IGNORECASE)


_PATTERNS = {part: _pattern(names) for part, names in _NAMES.items()}


@dataclass(frozen=True)
class _Said:
    """Where a part of a camera is said."""

    source: CalibrationSource
    keys: tuple[Key, ...]

    @property
    def value(self) -> Any:
        return self.source.get(*self.keys)

    @property
    def place(self) -> FilePosition:
        place = self.source.place(*self.keys)
        return FilePosition(place.key, place.line, self.source.path)

    def numbers(self) -> Array:
        return self.source.some_numbers(*self.keys)

    def matrix(self, shape: tuple[int, ...]) -> Array:
        return self.source.numbers(shape, *self.keys)


_Table = dict[str, dict[str, _Said]]


def _is_storage(source: CalibrationSource) -> bool:
    table = _table([source])
    return bool(table["K"]) or (bool(table["R"]) and bool(table["t"]))


def _table(sources: Sequence[CalibrationSource]) -> _Table:
    """Part -> suffix of a camera -> where it is said."""
    ranked: dict[str, dict[str, tuple[int, _Said]]] = {part: {} for part in _NAMES}
    for source in sources:
        for key in source.document if isinstance(source.document, dict) else ():
            for part, pattern in _PATTERNS.items():
                matched = pattern.fullmatch(str(key))
                value = source.document[key]
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
                    ranked[part][suffix] = rank, _Said(source, keys)
    return {part: {s: said for s, (_, said) in found.items()} for part, found in ranked.items()}


def _read(source: CalibrationSource) -> dict[str, RawCamera]:
    table = _table([source])
    if not table["K"] or not (table["R"] or table["t"] or table["rectified"]):
        other = _other_half(Path(source.path))
        if other is not None:
            table = _table([source, other])
    if not table["K"]:
        message = f"there is no camera matrix in it; it is looked for as {', '.join(_NAMES['K'])}"
        raise CameraError(message, path=source.path)
    cameras: dict[str, RawCamera] = {}
    stereo = list(table["K"]) == ["1", "2"] and "" in table["R"] and "" in table["t"]
    for suffix in table["K"]:
        name = suffix or str(source.get("camera_name") or "").strip() or Path(source.path).stem
        camera = _camera(
            {part: _of(found, suffix, part) for part, found in table.items()}, suffix, stereo, table
        )
        source.add(cameras, name, camera)
    return cameras


def _other_half(path: Path) -> CalibrationSource | None:
    """The file with the other half of the calibration."""
    for one, other in (("intri", "extri"), ("extri", "intri")):
        if one in path.name:
            sibling = path.with_name(path.name.replace(one, other))
            if sibling.is_file():
                text = read_text(sibling, CameraError, "calibration", 8 << 20)
                return parsed(str(sibling), text, container_of(str(sibling), text))
    return None


def _of(found: Mapping[str, _Said], suffix: str, part: str) -> _Said | None:
    """What is said of one camera, or, of lens models and sizes, of all."""
    shared = found.get("") if part in ("width", "height", "size", "model", "fisheye") else None
    return found.get(suffix, shared)


def _camera(said: Mapping[str, _Said | None], suffix: str, stereo: bool, table: _Table) -> RawCamera:
    k = said["K"]
    assert k is not None
    rotation, t = said["R"], said["t"]
    rectification, rectified = said["rectification"], said["rectified"]
    if stereo:
        rectification = rotation or rectification
        rotation, t = (None, None) if suffix == "1" else (table["R"][""], table["t"][""])
    elif rotation is not None and t is None and rectified is not None:
        rotation, rectification = None, rotation  # as in CameraInfo
    if (rotation is None) != (t is None):
        here, missing = (rotation, "T") if t is None else (t, "R")
        assert here is not None
        raise here.source.error(f"is here without {missing}", *here.keys)
    distortion = np.zeros(0) if said["distortion"] is None else said["distortion"].numbers()
    places = {part: at for part in _PARTS if (at := said[part]) is not None}
    return RawCamera(
        k.matrix((3, 3)),
        np.eye(3) if rotation is None else _rotation(rotation),
        np.zeros(3) if t is None else t.matrix((3,)),
        size=_size(said),
        distortion=tuple(distortion),
        model=_model(said, distortion),
        rectification=None if rectification is None else rectification.matrix((3, 3)),
        rectified=None if rectified is None else rectified.matrix((3, 4)),
        places={part: at.place for part, at in places.items()},
    )


def _rotation(said: _Said) -> Array:
    """A matrix, or Rodrigues' vector."""
    values = said.numbers()
    if len(values) == 3:
        return np.asarray(Rotation.from_rotvec(values).as_matrix(), dtype=float)
    return said.matrix((3, 3))


def _size(said: Mapping[str, _Said | None]) -> tuple[int, int] | None:
    width, height, size = said["width"], said["height"], said["size"]
    if width is not None and height is not None:
        return width.source.whole(*width.keys), height.source.whole(*height.keys)
    if size is None:
        return None
    values = size.matrix((2,))
    if any(v != int(v) or v <= 0 for v in values):
        raise size.source.error("needs width and height, whole numbers above zero", *size.keys)
    return int(values[0]), int(values[1])


def _model(said: Mapping[str, _Said | None], distortion: Array) -> str | None:
    """OpenCV tells its models by the number of coefficients, but a fisheye has 4 like the shortest other."""
    given, named, fisheye = said["distortion"], said["model"], said["fisheye"]
    word = "" if named is None else str(named.value).strip().lower()
    if word in ("", "pinhole", "perspective", "opencv"):
        is_fisheye = fisheye is not None and str(fisheye.value).strip().lower() not in ("0", "false", "no")
        word = "equidistant" if is_fisheye else "plumb_bob"
        if not is_fisheye and len(np.trim_zeros(distortion, "b")) > 5:
            word = "rational_polynomial"
        if given is not None and not is_fisheye and len(distortion) == 4 and distortion.any():
            hint = "if they are of cv2.fisheye, add distortion_model: equidistant"
            warn_about(given.source.path, f"{given.keys[0]}: 4 coefficients are taken for plumb_bob; {hint}")
    if given is None:
        return None if word != "equidistant" else word
    named_at = named or fisheye or given
    return lens_of(given.source, word, distortion, named_at.keys, given.keys)


# -- writing

_Entry = int | str | list[str] | Array


def _entries(cameras: Mapping[str, Camera]) -> dict[str, _Entry]:
    """Names and values of everything; matrices as arrays (rows, cols)."""
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
    entries: dict[str, _Entry] = {"names": list(cameras)}
    for name, camera in cameras.items():
        if _NAME.fullmatch(name) is None:
            raise CameraError("needs a name of letters, digits, _ and - in this form", key=name)
        own: dict[str, _Entry] = {
            f"W_{name}": camera.size[0],
            f"H_{name}": camera.size[1],
            f"K_{name}": camera.K,
            f"distortion_model_{name}": str(camera.model),
            f"dist_{name}": np.array([camera.distortion]),
            f"R_{name}": Rotation.from_matrix(camera.R).as_rotvec()[:, None],
            f"Rot_{name}": camera.R,
            f"T_{name}": camera.t[:, None],
            **_stereo_entries(camera, f"_{name}"),
        }
        if any(_is_name_of_a_part(key) for key in own):
            raise CameraError("this form cannot hold a camera of this name", key=name)
        entries |= own
    return entries


def _is_name_of_a_part(key: str) -> bool:
    """Whether a key, such as dist_coeffs, is read as a part of the only camera."""
    matches = (pattern.fullmatch(key) for pattern in _PATTERNS.values())
    return any(matched and not (matched[2] or matched[3]) for matched in matches)


def _stereo_entries(camera: Camera, suffix: str) -> dict[str, _Entry]:
    entries: dict[str, _Entry] = {}
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
        raise CameraError("this form cannot hold a camera of this name", key=text)
    return f'"{text}"'


def _write_json(cameras: Mapping[str, Camera]) -> dict[str, str]:
    def item(value: _Entry) -> Any:
        if not isinstance(value, np.ndarray):
            return value
        data = [float(number(v)) for v in value.ravel()]
        return {
            "type_id": "opencv-matrix",
            "rows": value.shape[0],
            "cols": value.shape[1],
            "dt": "d",
            "data": data,
        }

    return {"": json.dumps({key: item(value) for key, value in _entries(cameras).items()}, indent=1) + "\n"}


def _form(name: str, title: str, suffix: str, container: str, write: Any) -> CalibrationFormat:
    return CalibrationFormat(
        name, title, suffix, container, _is_storage, _read, write, holds_rectified=True, lenses=COUNTS
    )


OPENCV = _form("opencv", "OpenCV FileStorage YAML", ".yml", "yaml", _write_yaml)
OPENCV_XML = _form("opencv_xml", "OpenCV FileStorage XML", ".xml", "xml", _write_xml)
OPENCV_JSON = _form("opencv_json", "OpenCV FileStorage JSON", ".json", "json", _write_json)
