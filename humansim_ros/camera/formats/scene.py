"""The cameras of our own scene files: everything a camera is, in metres, for any number of them."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import CalibrationFormat, CalibrationSource, Key, RawCamera, row
from humansim_ros.camera.formats.models import COUNTS, lens_of
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.types import Array

_SIZE, _FOV = (640, 480), 60.0
#: Keys that are called as the parts of a camera are.
_PARTS = ("K", "R", "t", "size", "distortion", "rectification", "rectified")
#: What puts a camera somewhere else than it says itself, and what is not of the camera as it is calibrated.
_ELSEWHERE, _LEFT_OUT = ("calibration", "trajectory"), ("binning", "roi", "sensor")


def _is_scene(source: CalibrationSource) -> bool:
    return isinstance(source.get("cameras"), Mapping)


def _read(source: CalibrationSource) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for name in source.mapping("cameras"):
        source.add(cameras, str(name), _camera(source, name), "cameras", name)
    if not cameras:
        raise source.error("there are no cameras in it", "cameras")
    return cameras


def _camera(source: CalibrationSource, name: str) -> RawCamera:
    at: tuple[Key, ...] = ("cameras", name)
    source.mapping(*at)
    for key in _ELSEWHERE:
        if source.get(*at, key) is not None:
            raise source.error(f"cameras with a {key} file cannot be read here: use that file", *at, key)
    left_out = [key for key in _LEFT_OUT if source.get(*at, key) is not None]
    if left_out:
        warn_about(
            source.path, f"cameras.{name}: {' and '.join(left_out)} left out: this is the whole sensor"
        )
    size = _SIZE
    if source.get(*at, "size") is not None:
        source.numbers((2,), *at, "size")
        size = source.size((*at, "size", 0), (*at, "size", 1))
    distortion: Array = np.zeros(0)
    if source.get(*at, "distortion") not in (None, []):
        distortion = source.some_numbers(*at, "distortion")
    named = source.get(*at, "distortion_model")
    model_at, lens_at = (*at, "distortion_model"), (*at, "distortion")
    k, r, t = _matrices(source, at, size)
    rectification, rectified = (
        None if source.get(*at, key) is None else source.numbers(shape, *at, key)
        for key, shape in (("rectification", (3, 3)), ("rectified", (3, 4)))
    )
    return RawCamera(
        k,
        r,
        t,
        size=size,
        distortion=tuple(distortion),
        # without a name, Camera tells it by the number, as it does for scenes
        model=None if named is None else lens_of(source, named, distortion, model_at, lens_at),
        rectification=rectification,
        rectified=rectified,
        places={
            "": source.place(*at),
            **{part: source.place(*at, part) for part in _PARTS},
            "model": source.place(*model_at),
        },
    )


def _matrices(
    source: CalibrationSource, at: tuple[Key, ...], size: tuple[int, int]
) -> tuple[Array, Array, Array]:
    """K, R and t of any way to say them."""
    try:
        if source.get(*at, "P") is not None:
            camera = Camera.from_projection_matrix(source.numbers((3, 4), *at, "P"), size)
            return camera.K, camera.R, camera.t
        camera = Camera.look_at((0, 0, 0), (1, 0, 0), size, np.radians(_fov(source, at)))
        if source.get(*at, "position") is not None:
            up = (0, 0, 1) if source.get(*at, "up") is None else source.numbers((3,), *at, "up")
            position, target = (source.numbers((3,), *at, key) for key in ("position", "look_at"))
            camera = Camera.look_at(position, target, size, np.radians(_fov(source, at)), up)
            r, t = camera.R, camera.t
        else:
            r, t = source.numbers((3, 3), *at, "R"), source.numbers((3,), *at, "t")
    except CameraError as error:
        if error.path is not None:
            raise
        raise source.error(error.message, *at, *((error.key,) if error.key else ())) from None
    return camera.K if source.get(*at, "K") is None else source.numbers((3, 3), *at, "K"), r, t


def _fov(source: CalibrationSource, at: tuple[Key, ...]) -> float:
    return _FOV if source.get(*at, "fov_deg") is None else float(source.numbers((), *at, "fov_deg"))


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
    """A line for each matrix that is there."""
    lines = []
    for key, matrix in matrices.items():
        if matrix is not None:
            rows = ", ".join(f"[{row(values, ', ')}]" for values in matrix)
            lines.append(f"    {key}: [{rows}]")
    return lines


SCENE = CalibrationFormat(
    "scene",
    "cameras of a scene file",
    ".yaml",
    "yaml",
    _is_scene,
    _read,
    _write,
    holds_rectified=True,
    lenses=COUNTS,
)
