"""Projection matrices as plain text: P (3x4) of one camera or several, of any scale and sign.

A matrix is three lines of four numbers or one line of twelve. Its name is before it ("P0: ...") or on a line
above; a comment "# left 640x480" also gives the image size. The word CONTOUR, with which files of some data
sets begin, is ignored.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import (
    MAX_CAMERAS,
    CalibrationFile,
    CalibrationFormat,
    RawCamera,
    SourceLocation,
    check_words,
    row,
)
from humansim_ros.errors import CameraError
from humansim_ros.types import ImageSize

_SIZE = re.compile(r"([0-9]{1,5})x([0-9]{1,5})")
_NAMED = re.compile(r"([A-Za-z_][^\s:=]*)\s*[:=]\s*(.*)")


def _is_projection(file: CalibrationFile) -> bool:
    return next(_rows(file), None) is not None


def _rows(file: CalibrationFile) -> Iterator[tuple[int, str, list[str]]]:
    """Line, name and words of the rows of matrices. Only the first row of a matrix has a name, which may
    contain a size ("# name 640x480").
    """
    name = ""
    for line, text in file.all_lines():
        if text[:1] in ("#", ";", "%") or text.startswith("//"):
            name = text.lstrip("#;%/ ").strip()
            continue
        if not text or text.upper() == "CONTOUR":
            continue
        named = _NAMED.fullmatch(text)
        if named:
            name, text = named[1], named[2]
        words = text.strip("[]").replace(",", " ").replace(";", " ").split()
        if not words:
            continue
        if len(words) not in (4, 12):
            return
        yield line, name, words
        name = ""


def _read(file: CalibrationFile) -> dict[str, RawCamera]:
    matrices: list[tuple[int, str, list[float]]] = []
    last = 0
    for line, name, words in _rows(file):
        last = line
        values = file.row(words, line)
        incomplete = bool(matrices) and len(matrices[-1][2]) < 12
        if incomplete and len(values) == 4 and not name:
            matrices[-1][2].extend(values)
        elif incomplete:
            raise CameraError("the matrix above has fewer than three rows", path=file.path, line=line)
        elif len(matrices) == MAX_CAMERAS:
            raise CameraError(f"there are more than {MAX_CAMERAS} cameras", path=file.path, line=line)
        else:
            matrices.append((line, name, values))
    if len(matrices[-1][2]) < 12:
        raise CameraError("the last matrix has fewer than three rows", path=file.path, line=last)
    rest = next((n for n, text in file.lines() if n > last and text[0] not in "%/"), None)
    if rest is not None:
        message = "rows of P have 4 numbers each, or all 12 on one line"
        raise CameraError(message, path=file.path, line=rest)
    cameras: dict[str, RawCamera] = {}
    stem = Path(file.path).stem
    for number, (line, comment, values) in enumerate(matrices):
        name, size = _name_and_size(comment)
        name = name or (stem if len(matrices) == 1 else str(number))
        file.add(cameras, name, _camera(file, values, line, size), line=line)
    return cameras


def _name_and_size(comment: str) -> tuple[str, ImageSize | None]:
    """Name and size in a comment, which must be one word, or one word and a size."""
    words = comment.rstrip(":").split()
    size = _SIZE.fullmatch(words[-1]) if words else None
    if size:
        words = words[:-1]
    name = words[0] if len(words) == 1 else ""
    return name, (int(size[1]), int(size[2])) if size else None


def _camera(file: CalibrationFile, values: list[float], line: int, size: ImageSize | None) -> RawCamera:
    location = SourceLocation("P", line)
    try:
        # the decomposition of P does not depend on the image size
        camera = Camera.from_projection_matrix(np.reshape(values, (3, 4)), (1, 1))
    except CameraError as error:
        raise CameraError(error.message, path=file.path, line=line, key="P") from None
    return RawCamera(camera.K, camera.R, camera.t, size=size, locations={"": location})


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    check_words(cameras)
    lines = []
    for name, camera in cameras.items():
        lines += [f"# {name} {camera.size[0]}x{camera.size[1]}", *(row(values) for values in camera.P)]
    return {"": "\n".join(lines) + "\n"}


PROJECTION = CalibrationFormat("p", "projection matrices", ".txt", "text", _is_projection, _read, _write)
