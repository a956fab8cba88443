"""KRTD files of Kitware's tools: K (3x3), R (3x3), t (3) and distortion coefficients in this order, as text.

The coefficients are those of OpenCV without trailing zeros; a single 0 means no distortion.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from pathlib import Path

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import (
    CalibrationFile,
    CalibrationFormat,
    RawCamera,
    SourceLocation,
    row,
)
from humansim_ros.errors import CameraError

#: OpenCV has no more coefficients.
_MAX_COEFFICIENTS, _MAX_LINES = 14, 21


def _is_krtd(file: CalibrationFile) -> bool:
    return len(file.head) == 3 and all(len(line.split()) == 3 for line in file.head)


def _read(file: CalibrationFile) -> dict[str, RawCamera]:
    lines = [(line, text.split()) for line, text in islice(file.lines(), _MAX_LINES + 1)]
    if len(lines) < 7 or any(len(words) != 3 for _, words in lines[:7]):
        message = "needs K (3 x 3), R (3 x 3) and t (3), then the distortion coefficients or a 0"
        raise CameraError(message, path=file.path, line=lines[-1][0])
    count = sum(len(words) for _, words in lines) - 21
    if count > _MAX_COEFFICIENTS:
        message = (
            f"more than {_MAX_COEFFICIENTS} distortion coefficients: does the file hold more than one camera?"
        )
        raise CameraError(message, path=file.path, line=lines[7][0])
    numbers = np.array([value for line, words in lines for value in file.row(words, line)])
    distortion = numbers[21:]
    locations = {
        "K": SourceLocation("K", lines[0][0]),
        "R": SourceLocation("R", lines[3][0]),
        "t": SourceLocation("t", lines[6][0]),
    }
    if len(distortion):
        locations["distortion"] = SourceLocation("distortion", lines[7][0])
    camera = RawCamera(
        numbers[:9].reshape(3, 3),
        numbers[9:18].reshape(3, 3),
        numbers[18:21],
        distortion=tuple(distortion),
        locations=locations,
    )
    return {Path(file.path).stem: camera}


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    (camera,) = cameras.values()
    distortion = np.trim_zeros(np.array(camera.distortion), "b")
    blocks = [
        *("\n".join(row(values) for values in matrix) for matrix in (camera.K, camera.R)),
        row(camera.t),
        row(distortion) if len(distortion) else "0",
    ]
    return {"": "\n\n".join(blocks) + "\n"}


KRTD = CalibrationFormat(
    "krtd",
    "KRTD",
    ".krtd",
    "text",
    _is_krtd,
    _read,
    _write,
    multiple=False,
    holds_size=False,
    lenses={"plumb_bob": 5, "rational_polynomial": 8},
)
