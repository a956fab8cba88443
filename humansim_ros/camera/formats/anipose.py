"""TOML files of Anipose, which FreeMoCap, Caliscope and Pose2Sim write too: x_cam = R x + t.

The unit is that of the calibration board and is not in the file: millimetres for most boards, metres in
Pose2Sim. https://anipose.readthedocs.io/en/latest/aniposelib-tutorial.html
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import CalibrationFile, CalibrationFormat, RawCamera, row
from humansim_ros.camera.formats.containers import Keys, find_cameras, has_keys
from humansim_ros.camera.formats.lens_models import check_count
from humansim_ros.camera.formats.rotations import rotation_of, vector_of
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.types import Array

#: Names of units in a file, and metres per unit.
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
#: Key of the unit, and the tables in which it may be.
_UNIT, _UNIT_TABLES = "unit", ((), ("metadata",))
#: Extent of a rig in units of the file from which these are millimetres: between a room of 30 m and 10 cm.
_MILLIMETRES = 50.0
_PARTS = {"matrix", "rotation", "translation", "distortions"}


def _cameras(file: CalibrationFile) -> list[tuple[str, Keys]]:
    return find_cameras(file, has_keys({"matrix"}), has_keys(_PARTS))


def _is_anipose(file: CalibrationFile) -> bool:
    return bool(_cameras(file))


def _read(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for table, at in _cameras(file):
        name = str(file.get(*at, "name") or "").strip() or table
        file.add(cameras, name, _camera(file, at), *at)
    return cameras


def _camera(file: CalibrationFile, at: Keys) -> RawCamera:
    matrix = file.numbers((3, 3), *at, "matrix")
    distortion: Array = np.zeros(0)
    if file.get(*at, "distortions") not in (None, []):
        distortion = file.some_numbers(*at, "distortions")
    model = _model(file, at, distortion)
    rotation, t = file.get(*at, "rotation"), file.get(*at, "translation")
    if (rotation is None) != (t is None):
        present, missing = ("rotation", "translation") if t is None else ("translation", "rotation")
        raise file.error(f"needs {missing} as well", *at, present)
    keys = {"K": "matrix", "distortion": "distortions", "R": "rotation", "t": "translation", "size": "size"}
    return RawCamera(
        matrix,
        None if rotation is None else rotation_of(file, *at, "rotation"),
        np.zeros(3) if t is None else file.numbers((3,), *at, "translation"),
        size=file.pair_size(*at, "size"),
        distortion=tuple(distortion),
        model=model,
        locations={"": file.location(*at), **{part: file.location(*at, key) for part, key in keys.items()}},
    )


def _model(file: CalibrationFile, at: Keys, distortion: Array) -> str:
    fisheye = file.get(*at, "fisheye")
    if fisheye is not None and not isinstance(fisheye, bool):
        raise file.error("needs true or false", *at, "fisheye")
    if fisheye:
        model = "equidistant"
    else:
        model = "plumb_bob" if len(np.trim_zeros(distortion, "b")) <= 5 else "rational_polynomial"
    if len(distortion) >= 4 or model == "equidistant":
        check_count(file, model, distortion, (*at, "distortions"))
    return model


def _find_unit(file: CalibrationFile, cameras: Mapping[str, RawCamera]) -> float:
    for table in _UNIT_TABLES:
        value = file.get(*table, _UNIT)
        if value is not None:
            if value not in _UNITS:
                raise file.error(f"is {str(value)[:30]!r}: use {', '.join(_UNITS)}", *table, _UNIT)
            return _UNITS[value]
    positions = np.array([camera.position for camera in cameras.values() if camera.R is not None])
    if not len(positions):
        return 1.0
    # with the origin, which is the first camera or the board
    extent = float(np.linalg.norm(np.ptp(np.vstack([positions, np.zeros(3)]), axis=0)))
    if extent == 0:
        return 1.0
    name = "mm" if extent > _MILLIMETRES else "m"
    other = "m" if name == "mm" else "mm"
    warn_about(
        file.path,
        f"the unit is not in the file; {name} is assumed, because the cameras are then "
        f"{extent * _UNITS[name]:.3g} m apart ({extent * _UNITS[other]:.5g} m with {other}); to state it, "
        f'set unit, or add [metadata] with {_UNIT} = "{name}" to the file',
    )
    return _UNITS[name]


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    lines: list[str] = []
    for index, (name, camera) in enumerate(cameras.items()):
        matrix = ", ".join(f"[{row(values, ', ')}]" for values in camera.K)
        lines += [f"[cam_{index}]", f"name = {_text(name)}"]
        lines += [f"size = [{camera.size[0]}, {camera.size[1]}]", f"matrix = [{matrix}]"]
        lines += [f"distortions = [{row(camera.distortion, ', ')}]"]
        lines += [f"rotation = [{row(vector_of(camera.R), ', ')}]"]
        lines += [f"translation = [{row(camera.t, ', ')}]"]
        lines += [f"fisheye = {str(camera.model == 'equidistant').lower()}", ""]
    return {"": "\n".join([*lines, "[metadata]", f'{_UNIT} = "m"']) + "\n"}


def _text(name: str) -> str:
    if not name.isprintable():
        raise CameraError("this format needs a name without control characters", key=name)
    escaped: Any = name.replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


ANIPOSE = CalibrationFormat(
    "anipose",
    "Anipose, FreeMoCap, Pose2Sim TOML",
    ".toml",
    "toml",
    _is_anipose,
    _read,
    _write,
    lenses={"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4},
    find_unit=_find_unit,
)
