"""Table of all calibration formats, and writing of calibration files.

To add a format, give it a row of ``config/calibration_formats.json``. If its keys do not suffice, add
functions to the module of its family (:func:`calibration_format`), and the format to ``FORMATS`` there. The
rest of the package and the command line need no change. ``calibration.py`` converts units and axes, guesses
missing image sizes, checks cameras, and reports errors with file, line and key for all formats.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.cameras.formats import (
    datasets,
    devices,
    layouts,
    mocap,
    photogrammetry,
    plain_text,
    ros,
    thesis_cam,
)
from humansim_ros.cameras.formats.checks import has_pose
from humansim_ros.cameras.formats.table import ROWS, CalibrationFormat, calibration_format
from humansim_ros.errors import CameraError, located, some_of, unknown, warn_about
from humansim_ros.files.reading import atomic_path
from humansim_ros.types import Array

#: By the up axis of a file: the smallest rotation that turns the world of the file to z up.
Z_UP_FROM_FILE: Mapping[str, Array] = {
    "z": np.eye(3),
    "-z": np.diag([1.0, -1.0, -1.0]),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "-y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "x": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "-x": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
}
#: Formats by usual ends of file names, for names with a suffix that several formats share.
_USUAL_NAMES = {"par.txt": "middlebury", ".qca.txt": "qualisys", "transforms.json": "transforms", ".txt": "p"}
_SKEW_TOLERANCE = 1e-9
_FAMILIES = (layouts, photogrammetry, plain_text, mocap, devices, ros, datasets, thesis_cam)
_WITH_FUNCTIONS = {format.name: format for family in _FAMILIES for format in family.FORMATS}
#: All formats that can be read, in the order in which they are tried. The first one that recognises a file
#: reads it.
READ_FORMATS = tuple(_WITH_FUNCTIONS.get(name) or calibration_format(name) for name in ROWS)
#: All formats that can be written.
FORMATS = tuple(format for format in READ_FORMATS if "suffix" in ROWS[format.name])


def write_calibration(
    path: str | os.PathLike[str], cameras: Mapping[str, Camera], format: str | None = None
) -> list[Path]:
    """Write a calibration file. If writing fails, no partial file is left.

    ``path`` is a file. It is a folder for COLMAP, and also, without a suffix, for formats with one camera per
    file. ``format`` is the name of a format (docs/cameras.md). If None, the suffix of ``path`` decides. A
    HumansimWarning reports values that the format cannot store.

    Returns:
        The files that were written.

    Raises:
        CameraError: The format is unknown, it cannot store a lens or skew, or a file cannot be written.
    """
    target = Path(path)
    chosen = _format_of(target, format, len(cameras))
    if not cameras:
        raise CameraError("there is no camera to write", path=target)
    supported = {name: _with_supported_lens(target, name, camera, chosen) for name, camera in cameras.items()}
    rotation = Z_UP_FROM_FILE[chosen.up]
    in_file = {n: replace(c, R=c.R @ rotation, t=c.t / chosen.unit) for n, c in supported.items()}
    texts = _texts(target, in_file, chosen)
    for message in _losses(cameras, chosen):
        warn_about(target, message)
    for file in texts:
        if file.is_dir():
            raise CameraError("cannot be written: this is a folder", path=file)
    try:
        if len(texts) > 1 or next(iter(texts)).parent == target:
            target.mkdir(exist_ok=True)
        with located(CameraError), ExitStack() as stack:
            for file, text in texts.items():
                content = text if isinstance(text, bytes) else text.encode()
                stack.enter_context(atomic_path(file)).write_bytes(content)
    except OSError as reason:  # the folder cannot be created
        raise CameraError(f"cannot be written: {reason.strerror or reason}", path=target) from None
    except UnicodeEncodeError:
        raise CameraError("cannot be written: a name has an incomplete character", path=target) from None
    return list(texts)


def _format_of(target: Path, name: str | None, count: int) -> CalibrationFormat:
    names = {format.name: format for format in FORMATS}
    if name is not None:
        if name not in names:
            raise CameraError(unknown("calibration format", name, names), path=target)
        return names[name]
    suffix = target.suffix.lower()
    for ending, usual in _USUAL_NAMES.items():
        if target.name.lower().endswith(ending):
            return names[usual]
    matches = [format for format in FORMATS if format.suffix == suffix and suffix]
    if suffix in (".yaml", ".txt", ".yml") and matches and (count == 1 or matches[0].multiple):
        return matches[0]
    if len(matches) != 1:
        choices = [format.name for format in matches or FORMATS if format.multiple or count == 1]
        raise CameraError(f"choose the format to write: {', '.join(choices)}", path=target)
    return matches[0]


def _with_supported_lens(path: Path, name: str, camera: Camera, format: CalibrationFormat) -> Camera:
    """Return the same camera with a lens model that the format has. Raises CameraError if there is none."""
    if not format.holds_skew and abs(camera.K[0, 1]) > _SKEW_TOLERANCE * camera.K[0, 0]:
        raise _unsupported(path, name, format, "skew")
    counts = dict(format.lenses)
    model, d = str(camera.model), camera.distortion
    if not camera.distorted:
        return camera if model in counts else replace(camera, distortion=(), model="plumb_bob")
    if model == "rational_polynomial" and model not in counts and not any(d[5:]):
        model, d = "plumb_bob", d[:5]
    if model not in counts:
        raise _unsupported(path, name, format, f"{model} distortion")
    if any(d[counts[model] :]):
        raise _unsupported(
            path, name, format, f"{model} distortion with more than {counts[model]} coefficients"
        )
    return replace(camera, distortion=d, model=model)


def _unsupported(path: Path, name: str, format: CalibrationFormat, value: str) -> CameraError:
    hint = "idealize the camera first (humansim camera idealize), or choose another format"
    return CameraError(f"{format.title} cannot store {value}: {hint}", path=path, key=name)


def _losses(cameras: Mapping[str, Camera], format: CalibrationFormat) -> Iterator[str]:
    """Yield messages about values that the format cannot store."""
    if not format.holds_pose:
        posed = [name for name, camera in cameras.items() if has_pose(camera)]
        if posed:
            yield f"{format.title} does not store camera poses: R and t of {some_of(posed, 4)} are left out"
    if not format.holds_size:
        sizes = sorted({"{}x{}".format(*camera.size) for camera in cameras.values()})
        yield f"{format.title} does not store the image size: give {some_of(sizes, 4)} when it is read"
    if not format.holds_rectified:
        stereo = [n for n, c in cameras.items() if c.rectification is not None or c.rectified is not None]
        if stereo:
            yield f"{format.title} does not store R and P of rectified images: {some_of(stereo, 4)} lose them"


def _texts(target: Path, cameras: Mapping[str, Camera], format: CalibrationFormat) -> dict[Path, str | bytes]:
    """Content of each file to write, by path."""
    with located(path=target):
        if format.multiple or (len(cameras) == 1 and target.suffix and not target.is_dir()):
            texts = format.write(cameras)
            if "" in texts:
                file = target / f"cameras{format.suffix}" if target.is_dir() else target
                return {file: texts[""]}
            if target.exists() and not target.is_dir():
                raise CameraError(f"{format.title} needs a folder, and this is a file", path=target)
            # an empty file only satisfies readers, so it must not replace an existing file
            return {target / n: text for n, text in texts.items() if text or not (target / n).exists()}
        if target.suffix and not target.is_dir():
            message = f"{format.title} has one file per camera: give a folder for {len(cameras)} cameras"
            raise CameraError(message, path=target)
        files: dict[Path, str | bytes] = {}
        for name, camera in cameras.items():
            file = target / f"{re.sub(r'[^A-Za-z0-9_.-]', '_', name).lstrip('.') or '_'}{format.suffix}"
            if file in files:
                raise CameraError(f"two cameras would be written to {file.name}", path=target, key=name)
            files[file] = format.write({name: camera})[""]
        return files
