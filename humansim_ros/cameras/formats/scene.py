"""Cameras of scene files: any number of cameras with all their parameters, in metres."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np

from humansim_ros.cameras.camera.camera import Camera, look_at_pose, pinhole_of_fov
from humansim_ros.cameras.formats.base import CalibrationFile, Key, RawCamera, find_model, row
from humansim_ros.cameras.formats.table import calibration_format
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.types import Array

_SIZE, _FOV = (640, 480), 60.0
#: Keys of a scene file that have the same names as the parameters of Camera.
_PARTS = ("K", "R", "t", "size", "distortion", "rectification", "rectified")
#: Keys that take a camera from another file; and keys that are not part of a calibration.
_OTHER_FILES, _IGNORED = ("calibration", "trajectory"), ("binning", "roi", "sensor")


def _is_scene(file: CalibrationFile) -> bool:
    return isinstance(file.get("cameras"), Mapping)


def _read(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for name in file.mapping("cameras"):
        file.add(cameras, str(name), _camera(file, name), "cameras", name)
    if not cameras:
        raise file.error("the file has no cameras", "cameras")
    return cameras


def _camera(file: CalibrationFile, name: str) -> RawCamera:
    at: tuple[Key, ...] = ("cameras", name)
    file.mapping(*at)
    for key in _OTHER_FILES:
        if file.get(*at, key) is not None:
            raise file.error(
                f"a camera with a {key} file cannot be read from a scene: use that file", *at, key
            )
    ignored = [key for key in _IGNORED if file.get(*at, key) is not None]
    if ignored:
        warn_about(
            file.path, f"cameras.{name}: {' and '.join(ignored)} ignored: this camera is the whole sensor"
        )
    size = _SIZE
    if file.get(*at, "size") is not None:
        file.numbers((2,), *at, "size")
        size = file.size((*at, "size", 0), (*at, "size", 1))
    distortion = file.optional_numbers(*at, "distortion")
    name_in_file = file.get(*at, "distortion_model")
    model_keys, distortion_keys = (*at, "distortion_model"), (*at, "distortion")
    k, r, t = _matrices(file, at, size)
    rectification, rectified = (
        None if file.get(*at, key) is None else file.numbers(shape, *at, key)
        for key, shape in (("rectification", (3, 3)), ("rectified", (3, 4)))
    )
    return RawCamera(
        k,
        r,
        t,
        size=size,
        distortion=tuple(distortion),
        # if None, Camera decides by the number of coefficients, as in scenes
        model=None
        if name_in_file is None
        else find_model(file, name_in_file, distortion, model_keys, distortion_keys),
        rectification=rectification,
        rectified=rectified,
        locations=file.locations(at, **{part: part for part in _PARTS}, model="distortion_model"),
    )


def _matrices(
    file: CalibrationFile, at: tuple[Key, ...], size: tuple[int, int]
) -> tuple[Array, Array, Array]:
    """K, R and t, from whichever keys define them."""
    try:
        if file.get(*at, "P") is not None:
            camera = Camera.from_projection_matrix(file.numbers((3, 4), *at, "P"), size)
            return camera.K, camera.R, camera.t
        k = pinhole_of_fov(size, np.radians(_fov(file, at)))
        if file.get(*at, "position") is not None:
            up = (0, 0, 1) if file.get(*at, "up") is None else file.numbers((3,), *at, "up")
            position, target = (file.numbers((3,), *at, key) for key in ("position", "look_at"))
            r, t = look_at_pose(position, target, up)
        else:
            r, t = file.numbers((3, 3), *at, "R"), file.numbers((3,), *at, "t")
    except CameraError as error:
        if error.path is not None:
            raise
        raise file.error(error.message, *at, *((error.key,) if error.key else ())) from None
    return k if file.get(*at, "K") is None else file.numbers((3, 3), *at, "K"), r, t


def _fov(file: CalibrationFile, at: tuple[Key, ...]) -> float:
    return _FOV if file.get(*at, "fov_deg") is None else float(file.numbers((), *at, "fov_deg"))


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    lines = ["cameras:"]
    for name, camera in cameras.items():
        lines += [f"  {json.dumps(name)}:", f"    size: [{camera.size[0]}, {camera.size[1]}]"]
        lines += _matrix_lines({"K": camera.K, "R": camera.R})
        lines.append(f"    t: [{row(camera.t, ', ')}]")
        if camera.distorted:
            lines.append(f"    distortion: [{row(camera.distortion, ', ')}]")
            lines.append(f"    distortion_model: {camera.model}")
        lines += _matrix_lines({"rectification": camera.rectification, "rectified": camera.rectified})
    return {"": "\n".join(lines) + "\n"}


def _matrix_lines(matrices: Mapping[str, Array | None]) -> list[str]:
    """Lines of the matrices that are not None."""
    lines = []
    for key, matrix in matrices.items():
        if matrix is not None:
            rows = ", ".join(f"[{row(values, ', ')}]" for values in matrix)
            lines.append(f"    {key}: [{rows}]")
    return lines


SCENE = calibration_format("scene", _is_scene, _read, _write)
