"""Projection matrices as plain text: P (3x4) of one camera or several, of any scale and sign.

A matrix is three lines of four numbers, or one line of twelve, with its name before it ("P0: ...") or on a
line of its own above: a comment "# left 640x480" also says the size of the image. CONTOUR, which some data
sets begin with, is passed over.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.formats.base import (
    MAX_CAMERAS,
    CalibrationFormat,
    CalibrationSource,
    FilePosition,
    RawCamera,
    check_words,
    row,
)
from humansim_ros.errors import CameraError

_SIZE = re.compile(r"([0-9]{1,5})x([0-9]{1,5})")
_NAMED = re.compile(r"([A-Za-z_][^\s:=]*)\s*[:=]\s*(.*)")
_Size = tuple[int, int]


def _is_projection(source: CalibrationSource) -> bool:
    return next(_rows(source), None) is not None


def _rows(source: CalibrationSource) -> Iterator[tuple[int, str, list[str]]]:
    """Line, name and words of lines that could be rows of matrices. A name stands on the first row of its
    matrix only; in "# name 640x480" the size stays in it.
    """
    name = ""
    for line, text in source.all_lines():
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


def _read(source: CalibrationSource) -> dict[str, RawCamera]:
    matrices: list[tuple[int, str, list[float]]] = []
    last = 0
    for line, name, words in _rows(source):
        last = line
        values = source.row(words, line)
        unfinished = bool(matrices) and len(matrices[-1][2]) < 12
        if unfinished and len(values) == 4 and not name:
            matrices[-1][2].extend(values)
        elif unfinished:
            raise CameraError("the matrix above has fewer than three rows", path=source.path, line=line)
        elif len(matrices) == MAX_CAMERAS:
            raise CameraError(f"there are more than {MAX_CAMERAS} cameras", path=source.path, line=line)
        else:
            matrices.append((line, name, values))
    if len(matrices[-1][2]) < 12:
        raise CameraError("the last matrix has fewer than three rows", path=source.path, line=last)
    left = next((n for n, text in source.lines() if n > last and text[0] not in "%/"), None)
    if left is not None:
        message = "rows of P have 4 numbers each, or all 12 on one line"
        raise CameraError(message, path=source.path, line=left)
    cameras: dict[str, RawCamera] = {}
    stem = Path(source.path).stem
    for number, (line, said, values) in enumerate(matrices):
        name, size = _name_and_size(said)
        name = name or (stem if len(matrices) == 1 else str(number))
        source.add(cameras, name, _camera(source, values, line, size), line=line)
    return cameras


def _name_and_size(said: str) -> tuple[str, _Size | None]:
    """A comment is a name only if it is a word, or a word and a size."""
    words = said.rstrip(":").split()
    size = _SIZE.fullmatch(words[-1]) if words else None
    if size:
        words = words[:-1]
    name = words[0] if len(words) == 1 else ""
    return name, (int(size[1]), int(size[2])) if size else None


def _camera(source: CalibrationSource, values: list[float], line: int, size: _Size | None) -> RawCamera:
    place = FilePosition("P", line)
    try:
        # the image's size has no part in taking P apart
        camera = Camera.from_projection_matrix(np.reshape(values, (3, 4)), (1, 1))
    except CameraError as error:
        raise CameraError(error.message, path=source.path, line=line, key="P") from None
    return RawCamera(camera.K, camera.R, camera.t, size=size, places={"": place})


def _write(cameras: Mapping[str, Camera]) -> dict[str, str]:
    check_words(cameras)
    lines = []
    for name, camera in cameras.items():
        lines += [f"# {name} {camera.size[0]}x{camera.size[1]}", *(row(values) for values in camera.P)]
    return {"": "\n".join(lines) + "\n"}


PROJECTION = CalibrationFormat("p", "projection matrices", ".txt", "text", _is_projection, _read, _write)
