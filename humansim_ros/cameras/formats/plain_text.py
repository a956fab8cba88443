"""Plain text of numbers: projection matrices, KRTD, par.txt of the Middlebury data, MVSNet, COLMAP.

- A projection matrix P (3x4), of any scale and sign, is three lines of four numbers or one line of twelve.
  The name of a matrix stands before it ("P0: ...") or on a line above. A comment "# left 640x480" also gives
  the image size. Files of some data sets begin with the word CONTOUR, which is ignored.
- KRTD of Kitware's tools: K (3x3), R (3x3), t (3) and the distortion coefficients of OpenCV without trailing
  zeros; a single 0 means no distortion.
- par.txt: a count, then lines of an image name, K (9), R (9) and t (3); P = K [R | t].
  https://vision.middlebury.edu/mview/data/
- cam.txt of MVSNet: the matrix from the world to the camera (4x4) and K. https://github.com/YoYo000/MVSNet
- COLMAP: cameras.txt (intrinsics) and images.txt (poses, world to camera). The centre of the first pixel is
  (0.5, 0.5), so principal points are shifted by half a pixel when they are read or written.
  https://colmap.github.io/format.html, https://colmap.github.io/cameras.html
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.cameras.formats.base import (
    MAX_CAMERAS,
    CalibrationFile,
    RawCamera,
    SourceLocation,
    without_suffix,
)
from humansim_ros.cameras.formats.checks import size_of_named_image
from humansim_ros.cameras.formats.matrices import camera_of_model
from humansim_ros.cameras.formats.spellings import COLMAP_MODELS, COLMAP_PARAMETERS, role_of
from humansim_ros.cameras.formats.table import Values, calibration_format, image_names, row
from humansim_ros.errors import CameraError
from humansim_ros.files.reading import read_text
from humansim_ros.geometry import matrix_to_quaternion
from humansim_ros.types import ImageSize

_SIZE = re.compile(r"([0-9]{1,5})x([0-9]{1,5})")
#: Transforms that KITTI's calib.txt has in addition to cameras.
_OTHER_SENSORS = re.compile(r"(?:Tr(?:_[a-z_]+)?|R0?_rect)[:\s]")
_NAMED = re.compile(r"([A-Za-z_][^\s:=]*)\s*[:=]\s*(.*)")


def _rows(file: CalibrationFile) -> Iterator[tuple[int, str, list[str]]]:
    """Line, name and words of the rows of matrices. Only the first row of a matrix has a name, which may
    contain a size ("# name 640x480")."""
    name = ""
    for line, text in file.all_lines():
        if text[:1] in ("#", ";", "%") or text.startswith("//"):
            name = text.lstrip("#;%/ ").strip()
            continue
        if not text or text.upper() == "CONTOUR" or _OTHER_SENSORS.match(text):
            continue
        named = _NAMED.fullmatch(text)
        if named:
            name, text = named[1], named[2]
        words = text.strip("[]").replace(",", " ").replace(";", " ").split()
        if not words:
            continue
        if len(words) not in (4, 12) or role_of(words[0]) is not None:
            return
        yield line, name, words
        name = ""


def _read_projection(file: CalibrationFile) -> dict[str, RawCamera]:
    matrices: list[tuple[int, str, list[float]]] = []
    last = 0
    for line, name, words in _rows(file):
        last = line
        values = file.row(words, line)
        incomplete = bool(matrices) and len(matrices[-1][2]) < 12
        if incomplete and len(values) == 4 and not name:
            matrices[-1][2].extend(values)
        elif incomplete:
            raise file.error("the matrix above has fewer than three rows", line=line)
        elif len(matrices) == MAX_CAMERAS:
            raise file.error(f"there are more than {MAX_CAMERAS} cameras", line=line)
        else:
            matrices.append((line, name, values))
    if len(matrices) == 2 and matrices[-1][2] == [0, 0, 0, 1] and not matrices[-1][1]:
        message = "found one 4 x 4 matrix: rotation and translation; missing: K or focal length, image size"
        raise file.error(message, line=last)
    if len(matrices[-1][2]) < 12:
        count = sum(len(values) for _, _, values in matrices) // 4
        message = f"found {count} rows of 4 numbers, which are not matrices P of three rows each"
        raise file.error(f"{message}; missing: K or focal length", line=last)
    after = ((n, text) for n, text in file.lines() if n > last and not _OTHER_SENSORS.match(text))
    rest = next((n for n, text in after if text[0] not in "%/"), None)
    if rest is not None:
        message = "rows of P have 4 numbers each, or all 12 on one line"
        raise file.error(message, line=rest)
    cameras: dict[str, RawCamera] = {}
    stem = Path(file.path).stem
    for number, (line, comment, values) in enumerate(matrices):
        name, size = _name_and_size(comment)
        name = name or (stem if len(matrices) == 1 else str(number))
        matrix = np.reshape(values, (3, 4))
        file.add(cameras, name, file.projection(matrix, SourceLocation("P", line), size), line=line)
    return cameras


def _name_and_size(comment: str) -> tuple[str, ImageSize | None]:
    """Name and size in a comment. The comment must be one word, or one word and a size."""
    words = comment.rstrip(":").split()
    size = _SIZE.fullmatch(words[-1]) if words else None
    if size:
        words = words[:-1]
    name = words[0] if len(words) == 1 else ""
    return name, (int(size[1]), int(size[2])) if size else None


PROJECTION = calibration_format("p", lambda file: next(_rows(file), None) is not None, _read_projection)


#: Most distortion coefficients of OpenCV, and most lines of a KRTD file.
_MAX_COEFFICIENTS, _MAX_LINES = 14, 21


def _is_krtd(file: CalibrationFile) -> bool:
    rows = [line.split() for line in file.head]
    return len(rows) == 3 and all(len(row) == 3 and row[0][:1].strip("+-.0123456789") == "" for row in rows)


def _read_krtd(file: CalibrationFile) -> dict[str, RawCamera]:
    lines = [(line, text.split()) for line, text in islice(file.lines(), _MAX_LINES + 1)]
    if len(lines) < 7 or any(len(words) != 3 for _, words in lines[:7]):
        message = "needs K (3 x 3), R (3 x 3) and t (3), then the distortion coefficients or a 0"
        raise file.error(message, line=lines[-1][0])
    count = sum(len(words) for _, words in lines) - 21
    if count > _MAX_COEFFICIENTS:
        message = (
            f"more than {_MAX_COEFFICIENTS} distortion coefficients: does the file hold more than one camera?"
        )
        raise file.error(message, line=lines[7][0])
    numbers = np.array([value for line, words in lines for value in file.row(words, line)])
    starts = {"K": 0, "R": 3, "t": 6, **({"distortion": 7} if count else {})}
    return {
        Path(file.path).stem: RawCamera(
            numbers[:9].reshape(3, 3),
            numbers[9:18].reshape(3, 3),
            numbers[18:21],
            distortion=tuple(numbers[21:]),
            locations={part: SourceLocation(part, lines[first][0]) for part, first in starts.items()},
        )
    }


def _trimmed(own: Values, camera: Camera) -> Values:
    return {"trimmed": row(np.trim_zeros(np.array(camera.distortion), "b")) or "0"}


KRTD = calibration_format("krtd", _is_krtd, _read_krtd, values=_trimmed)


def _is_par(file: CalibrationFile) -> bool:
    count, *images = file.head or [""]
    return count.isdecimal() and bool(images) and len(images[0].split()) > 12


def _read_middlebury(file: CalibrationFile) -> dict[str, RawCamera]:
    lines = file.lines()
    first, count = next(lines)
    cameras: dict[str, RawCamera] = {}
    folder = Path(file.path).parent
    for line, text in lines:
        image, *words = text.split()
        if len(words) != 21:
            message = f"needs an image name, K (9), R (9) and t (3): 21 numbers, not {len(words)}"
            raise file.error(message, line=line)
        values = np.array(file.row(words, line))
        camera = RawCamera(
            values[:9].reshape(3, 3),
            values[9:18].reshape(3, 3),
            values[18:],
            size=size_of_named_image(folder, image),
            locations={"": SourceLocation(None, line)},
        )
        file.add(cameras, without_suffix(image), camera, line=line)
    if not 0 < len(cameras) == int(count[:9]):
        message = f"declares {count[:9]} cameras, but has {len(cameras)}: is the file complete?"
        raise file.error(message, line=first)
    return cameras


MIDDLEBURY = calibration_format("middlebury", _is_par, _read_middlebury)


# -- MVSNet


def _read_mvsnet(file: CalibrationFile) -> dict[str, RawCamera]:
    lines = list(islice(file.lines(), 12))
    words = [text.split() for _, text in lines]
    inner = next((i for i, w in enumerate(words) if w[0].lower() == "intrinsic"), None)
    if inner != 5 or [len(w) for w in words[1:5]] != [4] * 4 or [len(w) for w in words[6:9]] != [3] * 3:
        message = "needs 'extrinsic' with 4 x 4 numbers, then 'intrinsic' with 3 x 3 numbers"
        raise file.error(message, line=lines[-1][0])
    pose = np.array([file.row(w, line) for w, (line, _) in zip(words[1:5], lines[1:5], strict=True)])
    k = np.array([file.row(w, line) for w, (line, _) in zip(words[6:9], lines[6:9], strict=True)])
    if not np.allclose(pose[3], [0, 0, 0, 1], atol=1e-6):
        message = "needs 0 0 0 1 as the last row of its 4 x 4 numbers"
        raise file.error(message, "extrinsic", line=lines[4][0])
    at = SourceLocation("extrinsic", lines[1][0])
    where = {"K": SourceLocation("intrinsic", lines[6][0]), "R": at, "t": at}
    name = Path(file.path).stem.removesuffix("_cam")
    return {name: RawCamera(k, pose[:3, :3], pose[:3, 3], locations=where)}


MVSNET = calibration_format(
    "mvsnet", lambda file: bool(file.head) and file.head[0].lower() == "extrinsic", _read_mvsnet
)


# -- COLMAP

CAMERAS, IMAGES, POINTS = "cameras.txt", "images.txt", "points3D.txt"
#: Largest file of a rig, bytes. Larger files are models of large scenes.
MAX_BYTES = 64 << 20


def _is_colmap(file: CalibrationFile) -> bool:
    if Path(file.path).name in (CAMERAS, IMAGES):
        return True
    words = file.head[0].split() if file.head else []
    return len(words) > 4 and words[1] in COLMAP_MODELS


def _read_colmap(file: CalibrationFile) -> dict[str, RawCamera]:
    """Read cameras.txt or images.txt, together with the other file in the same folder."""
    path = Path(file.path)
    both = {path.name: file}
    for name in (CAMERAS, IMAGES) if path.name in (CAMERAS, IMAGES) else ():
        other = path.with_name(name)
        if name != path.name and (name == CAMERAS or other.is_file()):
            text = read_text(other, CameraError, f"COLMAP {other.stem}", MAX_BYTES)
            both[name] = CalibrationFile(str(other), text)
    models = _read_models(both.get(CAMERAS, file))
    images = both.get(IMAGES)
    if images is None:
        return models
    cameras: dict[str, RawCamera] = {}
    for line, words in _image_lines(images):
        raw = _posed_camera(images, models, line, words)
        images.add(cameras, without_suffix(" ".join(words[9:])), raw, line=line)
    if not cameras:
        raise images.error("the file has no images, so the cameras have no poses")
    return cameras


def _read_models(file: CalibrationFile) -> dict[str, RawCamera]:
    cameras: dict[str, RawCamera] = {}
    for line, text in file.lines():
        name, *words = text.split()
        model = words[0] if words else ""
        values = file.row(words[1:], line) if model in COLMAP_PARAMETERS else []
        camera = camera_of_model(model, values[2:], SourceLocation(None, line, file.path))
        if any(v != int(v) or v <= 0 for v in values[:2]):
            raise file.error("width and height must be whole numbers above zero", line=line)
        file.add(cameras, name, replace(camera, size=(int(values[0]), int(values[1]))), line=line)
    if not cameras:
        raise file.error("the file has no cameras")
    return cameras


def _image_lines(file: CalibrationFile) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and words of images. After each image, a line of points (three words each) or an empty
    line is left out."""
    image = False
    for line, text in file.all_lines():
        if text.startswith("#"):
            continue
        words = text.split()
        if image and len(words) % 3 == 0:
            image = False
        elif words:
            image = True
            yield line, words


def _posed_camera(
    file: CalibrationFile, models: Mapping[str, RawCamera], line: int, words: list[str]
) -> RawCamera:
    if len(words) < 10:
        message = "needs an image id, a quaternion w x y z, a translation x y z, a camera id and a name"
        raise file.error(message, line=line)
    values = np.array(file.row(words[1:8], line))
    rotation = file.unit_rotation(np.roll(values[:4], -1), line=line, slack=1e-3)
    model = models.get(words[8])
    if model is None:
        raise file.error(f"there is no camera {words[8][:40]} in {CAMERAS}", line=line)
    locations = {**model.locations, **dict.fromkeys(("R", "t"), SourceLocation(None, line, file.path))}
    return replace(model, R=rotation, t=values[4:], locations=locations)


def _write_colmap(cameras: Mapping[str, Camera]) -> dict[str, str]:
    images = image_names(cameras)
    intrinsics = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    outer = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for index, (name, camera) in enumerate(cameras.items(), 1):
        model, coefficients = _model_of(camera)
        k = camera.K
        numbers = (k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, *coefficients)
        intrinsics.append(f"{index} {model} {camera.size[0]} {camera.size[1]} {row(numbers)}")
        x, y, z, w = matrix_to_quaternion(camera.R)
        outer += [f"{index} {row((w, x, y, z, *camera.t))} {index} {images[name]}", ""]
    return {CAMERAS: "\n".join(intrinsics) + "\n", IMAGES: "\n".join(outer) + "\n", POINTS: ""}


def _model_of(camera: Camera) -> tuple[str, tuple[float, ...]]:
    if camera.model == "equidistant":
        return "OPENCV_FISHEYE", camera.distortion
    if not camera.distorted:
        return "PINHOLE", ()
    if not any(camera.distortion[4:]):
        return "OPENCV", camera.distortion[:4]
    return "FULL_OPENCV", (*camera.distortion, 0.0, 0.0, 0.0)[:8]


COLMAP = calibration_format("colmap", _is_colmap, _read_colmap, _write_colmap)

FORMATS = (COLMAP, KRTD, MIDDLEBURY, MVSNET, PROJECTION)
