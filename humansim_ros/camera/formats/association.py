"""JSON files of 4DAssociation and related programs: K, RT (3x4) or R and T, distCoeff, imgSize; x = R X + t.

Metres, z up. The world of the Shelf data in this format is the floor.
https://github.com/zhangyux15/4d_association
"""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import CalibrationFile, CalibrationFormat, RawCamera, nested
from humansim_ros.camera.formats.containers import Keys, find_cameras, has_keys
from humansim_ros.camera.formats.lens_models import check_count
from humansim_ros.camera.formats.rotations import rotation_of
from humansim_ros.types import Array

#: Keys of the lens, in order of precedence.
_LENS = ("distCoeff", "distCoeffs", "distCoef", "distortion_coefficients", "D")


def _cameras(file: CalibrationFile) -> list[tuple[str, Keys]]:
    return find_cameras(file, _is_camera, has_keys({"K", "RT"}))


def _is_camera(value: object) -> bool:
    return isinstance(value, dict) and "K" in value and not value.keys().isdisjoint(("RT", "imgSize"))


def _is_association(file: CalibrationFile) -> bool:
    return bool(_cameras(file))


def _read(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for name, at in _cameras(file):
        file.add(cameras, name, _camera(file, at), *at)
    return cameras


def _camera(file: CalibrationFile, at: Keys) -> RawCamera:
    k = file.numbers((3, 3), *at, "K")
    r, t, (r_key, t_key) = _pose(file, at)
    lens = next((key for key in _LENS if file.get(*at, key) not in (None, [])), _LENS[0])
    distortion: Array = np.zeros(0)
    if file.get(*at, lens) not in (None, []):
        distortion = file.some_numbers(*at, lens)
    model = "plumb_bob" if len(np.trim_zeros(distortion, "b")) <= 5 else "rational_polynomial"
    check_count(file, model, distortion, (*at, lens))
    keys = {"K": "K", "R": r_key, "t": t_key, "distortion": lens, "size": "imgSize"}
    return RawCamera(
        k,
        r,
        t,
        size=file.pair_size(*at, "imgSize"),
        distortion=tuple(distortion),
        model=model,
        locations={"": file.location(*at), **{part: file.location(*at, key) for part, key in keys.items()}},
    )


def _pose(file: CalibrationFile, at: Keys) -> tuple[Array | None, Array, tuple[str, str]]:
    """R and t, and their keys: from RT (3x4 or 4x4), or from R and T; R is None without any."""
    if file.get(*at, "RT") is not None:
        values = file.some_numbers(*at, "RT")
        matrix = file.numbers((4, 4) if len(values) == 16 else (3, 4), *at, "RT")
        if len(matrix) == 4 and not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
            raise file.error("needs 0 0 0 1 as the last row of its 4 x 4 numbers", *at, "RT")
        return matrix[:3, :3], matrix[:3, 3], ("RT", "RT")
    t_key = next((key for key in ("T", "t") if file.get(*at, key) is not None), "T")
    if file.get(*at, "R") is None and file.get(*at, t_key) is None:
        return None, np.zeros(3), ("R", t_key)
    return rotation_of(file, *at, "R"), file.numbers((3,), *at, t_key), ("R", t_key)


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    data = {
        name: {
            "K": nested(camera.K.ravel()),
            "RT": nested(np.column_stack([camera.R, camera.t]).ravel()),
            "distCoeff": nested(np.array(camera.distortion)),
            "imgSize": list(camera.size),
        }
        for name, camera in cameras.items()
    }
    return {"": json.dumps(data, indent=1) + "\n"}


ASSOCIATION = CalibrationFormat(
    "4dassociation",
    "4DAssociation JSON",
    ".json",
    "json",
    _is_association,
    _read,
    _write,
    lenses={"plumb_bob": 5, "rational_polynomial": 8},
)
