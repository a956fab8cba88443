"""Read calibration files. Cameras have x_cam = R x_world + t in metres and ``map``.

The content of a file decides its format, not its name. docs/cameras.md lists the formats and their
conventions. The other modules of this folder read and write the formats.
"""

from __future__ import annotations

import os
import re
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from humansim_ros.cameras.camera.camera import MAX_SIZE, Camera
from humansim_ros.cameras.formats.base import CalibrationFile, RawCamera, SourceLocation
from humansim_ros.cameras.formats.checks import (
    check_focal_length,
    check_image_size,
    guess_image_size,
    image_size,
)
from humansim_ros.cameras.formats.conventions import check_unread, other_lens
from humansim_ros.cameras.formats.layouts import MATRICES, MATRICES_NPZ
from humansim_ros.cameras.formats.matrices import (
    is_matrices,
    missing_parts,
    read_matrices,
    read_poses,
)
from humansim_ros.cameras.formats.plain_text import CAMERAS, IMAGES
from humansim_ros.cameras.formats.plain_text import MAX_BYTES as MAX_BYTES_COLMAP
from humansim_ros.cameras.formats.spellings import INTRINSIC, POSE, find_parameters, numbers_found, plain
from humansim_ros.cameras.formats.syntax import name_of_half, other_half, read_document
from humansim_ros.cameras.formats.table import CalibrationFormat
from humansim_ros.cameras.formats.thesis_cam import SCENE
from humansim_ros.cameras.formats.writing import FORMATS, READ_FORMATS, Z_UP_FROM_FILE
from humansim_ros.errors import CameraError, HumansimWarning, located, some_of, warn_about
from humansim_ros.files.reading import exists, resource_root
from humansim_ros.geometry import nearest_rotations
from humansim_ros.types import Array, ImageSize

_MAX_BYTES = 8 << 20
#: Suffixes of the files that are read as calibrations if a folder is given.
_SUFFIXES = (
    *(".yaml", ".yml", ".json", ".toml", ".xml", ".ini", ".txt", ".cam", ".krtd", ".npz", ".csv", ".conf"),
    *(".xcp", ".mcal", ".sfm", ".out", ".cal", ".calib", ".calibration"),
)
#: Folders of WildTrack: calibrations of the images as they were taken, which are ignored if the other folder
#: exists; and calibrations of the images of the data set, which have no distortion.
_TAKEN, _UNDISTORTED = "intrinsic_original", "intrinsic_zero"
#: A folder with more files than this in its subfolders is taken for a folder of frames, not of cameras.
_MOST_BELOW = 200
#: Images are taken to be of equal size if principal points differ from the median by at most this fraction.
_SAME_IMAGE = 0.25
#: Smallest image side that is guessed, pixels.
_SMALLEST_GUESS = 16


@dataclass(frozen=True)
class Calibration:
    """Content of a calibration file.

    ``cameras``: cameras by name. ``format``: format of the file; None for a folder with files of several
    formats. ``unit``: metres per unit of the file. ``up``: axis of the file that points up. ``sizes``: image
    sizes that the file states, by camera. ``posed``: names of the cameras with extrinsics.
    """

    cameras: dict[str, Camera]
    format: CalibrationFormat | None
    unit: float
    up: str
    sizes: dict[str, ImageSize]
    posed: frozenset[str]


class _UnknownFormat(CameraError):
    """A file that can be read, but has no known calibration format."""


def read_calibration(
    path: str | os.PathLike[str],
    *,
    size: ImageSize | None = None,
    unit: float | None = None,
    up: str | None = None,
    image: str | os.PathLike[str] | None = None,
    extrinsics: str | os.PathLike[str] | None = None,
) -> dict[str, Camera]:
    """Read the cameras of a calibration file of any known format.

    Args:
        path: File, folder with calibration files or a COLMAP model, or URL as for :func:`resolve_url`.
        size: Width and height of the images in pixels, in place of the size in the file. If neither ``size``
            nor ``image`` is given and the file has no sizes, a common size that fits its principal points is
            assumed, with a HumansimWarning.
        unit: Metres per unit of the file. If None, the unit of the format.
        up: Axis of the file that points up, such as ``z`` or ``-y``. If None, the axis of the format.
        image: PNG or JPEG file that has the size of the images.
        extrinsics: File with the extrinsics, if ``path`` has only intrinsics. Both files must name the
            cameras alike, or have the same number of cameras in the same order.

    Returns:
        Cameras by name, in the order of the file. If only some cameras have extrinsics, the others are left
        out, with a HumansimWarning. If no camera has extrinsics, all are at the origin and look along +z.

    Raises:
        CameraError: The file cannot be read, or is not a calibration. The error names the file, and the key
            or line.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from humansim_ros.cameras import Camera, read_calibration, write_calibration
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "rig.json"
        ...     _ = write_calibration(path, {"left": Camera.look_at((3, 3, 2), (0, 0, 1))}, "panoptic")
        ...     cameras = read_calibration(path)
        >>> list(cameras), cameras["left"].size
        (['left'], (640, 480))
    """
    return load_calibration(path, size=size, unit=unit, up=up, image=image, extrinsics=extrinsics).cameras


def load_calibration(
    path: str | os.PathLike[str],
    *,
    size: ImageSize | None = None,
    unit: float | None = None,
    up: str | None = None,
    image: str | os.PathLike[str] | None = None,
    extrinsics: str | os.PathLike[str] | None = None,
    all_cameras: bool = False,
) -> Calibration:
    """Read a file like :func:`read_calibration`. Returns also its format, unit, up axis and image sizes.

    Args:
        path: The same as in :func:`read_calibration`, like all arguments up to ``extrinsics``.
        size: (width, height) of the images, pixels.
        unit: Metres per unit of the file.
        up: Up axis of the file.
        image: Image with the size.
        extrinsics: File of the extrinsics.
        all_cameras: Whether cameras without extrinsics are kept, for a caller that needs no extrinsics.

    Raises:
        CameraError: The file cannot be read, or is not a calibration.
    """
    if unit is not None and not 0 < unit < np.inf:
        raise CameraError("the unit must be above zero metres", key="unit")
    if up is not None and up not in Z_UP_FROM_FILE:
        raise CameraError(f"{up!r} is not an axis: use x, y, z, -x, -y or -z", key="up")
    if image is not None and size is None:
        size = image_size(image)
    if size is not None and not all(0 < side <= MAX_SIZE for side in size):
        message = f"the image size must be 1 to {MAX_SIZE} pixels, not {size[0]}x{size[1]}"
        raise CameraError(message, key="size")
    file = _file_of(path)
    if exists(file) and file.is_dir():
        if extrinsics is not None:
            raise CameraError("extrinsics go with a file, not with a folder", path=file)
        return _folder(file, size, unit, up, all_cameras)
    parsed = _parse(file, size)
    posed_by = parsed
    extrinsics = _half_without_poses(parsed) if extrinsics is None else extrinsics
    if extrinsics is None:
        format = _detect_format(parsed)
        raw = format.read(parsed)
    else:
        posed_by = _parse(_file_of(extrinsics), size)
        format, raw = _read_pair(parsed, posed_by)
    if format is MATRICES or (parsed.document is not None and format is not SCENE):
        check_unread(parsed, raw)
    if not all_cameras:
        raw = _with_poses(parsed, raw)
    if unit is None:
        unit = format.unit if format.find_unit is None else format.find_unit(posed_by, raw)
    up = format.up if up is None else up
    sizes = _sizes(parsed.path, raw, format, size)
    rotation = Z_UP_FROM_FILE[up]
    cameras = {name: _camera(parsed.path, name, raw[name], sizes[name], unit, rotation) for name in raw}
    in_file = {name: camera.size for name, camera in raw.items() if camera.size is not None}
    posed = frozenset(name for name, camera in raw.items() if camera.R is not None)
    return Calibration(cameras, format, unit, up, in_file, posed)


def _file_of(path: str | os.PathLike[str]) -> Path:
    """File or folder of a path or URL. For a folder with a COLMAP model, its file of images or cameras."""
    file = resolve_url(path) if isinstance(path, str) and "://" in path else Path(path)
    if exists(file) and (file / CAMERAS).is_file():
        return file / (IMAGES if (file / IMAGES).is_file() else CAMERAS)
    return file


def _parse(file: Path, size: ImageSize | None) -> CalibrationFile:
    most = MAX_BYTES_COLMAP if file.name in (CAMERAS, IMAGES) else _MAX_BYTES
    return replace(read_document(file, most), given_size=size)


def _half_without_poses(file: CalibrationFile) -> Path | None:
    """Find the second file of a pair of JSON or npz files: extrinsics for intrinsics, or the opposite."""
    half = other_half(Path(file.path)) if file.syntax in ("json", "npz") else None
    if half is None:
        return None
    found = find_parameters(file)
    if bool(found.having(INTRINSIC)) == bool(found.having(POSE)):
        return None
    warn_about(file.path, f"read together with {half.name}")
    return half


def has_only_extrinsics(path: str | os.PathLike[str]) -> bool:
    """Whether a file has rotations or translations of cameras, but no intrinsics. Raises CameraError."""
    file = _file_of(path)
    if not file.is_file():
        return False
    parsed = _parse(file, None)
    if parsed.document is None or _other_format(parsed) is not None:
        return False
    return bool(find_parameters(plain(parsed)).having(POSE))


def paired(inner: Sequence[str], outer: Sequence[str]) -> list[tuple[str, str]]:
    """Pair files of intrinsics with files of extrinsics: by their names, or else in their order."""
    named = {name_of_half(Path(file).stem): file for file in outer}
    found = [named.get(name_of_half(Path(file).stem), "") for file in inner]
    return list(zip(inner, found if {*found} == {*outer} else outer, strict=True))


def _other_format(file: CalibrationFile) -> CalibrationFormat | None:
    """Find the format of a file. Returns None for an unknown format, and for an OpenCV file without
    intrinsics."""
    format = _format_or_none(file)
    opencv = format is not None and format.name.startswith("opencv")
    return None if opencv and not find_parameters(plain(file)).having(INTRINSIC) else format


def _read_pair(
    inner: CalibrationFile, outer: CalibrationFile
) -> tuple[CalibrationFormat, dict[str, RawCamera]]:
    """Read a file with intrinsics and a file with extrinsics, in any order. Returns the format and the
    cameras."""
    if not is_matrices(inner) and is_matrices(outer):
        inner, outer = outer, inner
    generic = (None, MATRICES, MATRICES_NPZ)
    if all(file.document is not None and _other_format(file) in generic for file in (inner, outer)):
        return MATRICES, read_matrices(inner, outer)
    format = _detect_format(inner)
    raw = format.read(inner)
    other = _other_format(outer)
    posed = read_poses(outer) if other is None else other.read(outer)
    posed = {name: camera for name, camera in posed.items() if camera.R is not None}
    if not posed:
        raise outer.error("the file has no extrinsics")
    if set(posed).isdisjoint(raw):
        if other is not None and all(camera.R is not None for camera in raw.values()):
            message = "both files have intrinsics and extrinsics: give one of them, or a folder with both"
            raise outer.error(message)
        if len(posed) != len(raw):
            known = f"is in {inner.path} ({some_of(raw, 3)})"
            raise outer.error(f"no camera of this file, such as {some_of(posed, 3)}, {known}")
        named, others = [list(map(name_of_half, names)) for names in (raw, posed)]
        if named != others:
            warn_about(outer.path, f"{some_of(posed, 3)} are taken for {some_of(raw, 3)}, in their order")
        raw = dict(zip(named, raw.values(), strict=True))
        posed = dict(zip(raw, posed.values(), strict=True))
    joined = {
        name: replace(camera, R=pose.R, t=pose.t, center=pose.center) if (pose := posed.get(name)) else camera
        for name, camera in raw.items()
    }
    if other is not None:
        format = replace(format, unit=other.unit, up=other.up, find_unit=other.find_unit)
    return format, joined


def _with_poses(file: CalibrationFile, raw: dict[str, RawCamera]) -> dict[str, RawCamera]:
    """Return the cameras with extrinsics. If no camera has extrinsics, return all."""
    path = file.path
    posed = {name: camera for name, camera in raw.items() if camera.R is not None}
    missing = [name for name in raw if name not in posed]
    if posed and missing:
        warn_about(path, f"left out, because the file has no extrinsics of them: {some_of(missing, 4)}")
    elif len(missing) > 1:
        unread = find_parameters(file).having(POSE) if file.document is not None else []
        what = "the file has no extrinsics"
        if unread:
            what = f"the extrinsics in the file were not understood ({some_of(map('.'.join, unread), 3)})"
        elif file.document is not None and (numbers := numbers_found(plain(file), least=3)):
            what += f" under known keys (there are {', '.join(numbers)})"
        warn_about(path, f"{what}: all cameras are at the origin")
    return posed or raw


def _folder(
    folder: Path, size: ImageSize | None, unit: float | None, up: str | None, all_cameras: bool
) -> Calibration:
    """Read all calibrations of a folder. The arguments are those of :func:`load_calibration`."""
    read: dict[Path, Calibration] = {}
    for pattern in ("*", "*/*"):  # EuRoC and WildTrack have the files one folder deeper
        for file in [] if read else _files(folder, pattern):
            try:
                read[file] = load_calibration(file, size=size, unit=unit, up=up, all_cameras=all_cameras)
            except _UnknownFormat:
                warn_about(file, "is not a known calibration format: ignored")
    if not read:
        hint = "its cameras.bin can be read after colmap model_converter --output_type TXT"
        binary = f"; {hint}" if (folder / "cameras.bin").is_file() else ""
        raise CameraError(f"no calibration in this folder ({', '.join(_SUFFIXES)}){binary}", path=folder)
    names = _unique_names({str(file): list(calibration.cameras) for file, calibration in read.items()})
    each = [(names[str(file), name], name, one) for file, one in read.items() for name in one.cameras]
    first = next(iter(read.values()))
    return Calibration(
        {unique: one.cameras[name] for unique, name, one in each},
        first.format if all(one.format is first.format for one in read.values()) else None,
        first.unit,
        first.up,
        {unique: one.sizes[name] for unique, name, one in each if name in one.sizes},
        frozenset(unique for unique, name, one in each if name in one.posed),
    )


def _files(folder: Path, pattern: str) -> list[Path]:
    """Find the calibration files in a folder, without the second files of pairs. Raises CameraError."""
    try:
        next(folder.iterdir(), None)
        files = sorted(f for f in folder.glob(pattern) if f.suffix.lower() in _SUFFIXES and f.is_file())
    except OSError as reason:
        raise CameraError(f"cannot read the folder: {reason.strerror}", path=folder) from None
    if "/" in pattern and len(files) > _MOST_BELOW:
        return []
    matrices = [f for f in files if f.name.lower().endswith(".pmat.cal")]  # files of MultiCamSelfCal
    halves = {other_half(f) for f in files if "intr" in f.name}
    taken = {f.parent for f in files if f.parent.name == _TAKEN and (f.parent.parent / _UNDISTORTED).is_dir()}
    return [f for f in matrices or files if f not in halves and f.parent not in taken]


def join_calibrations(read: Mapping[str, Mapping[str, Camera]]) -> dict[str, Camera]:
    """Join the cameras of several files (path -> cameras) to one rig.

    ``read``: cameras of each path. If cameras have the same name, each is named after its file, with a
    HumansimWarning.

    Raises:
        CameraError: The names of the files are the same too.
    """
    names = _unique_names({path: list(cameras) for path, cameras in read.items()})
    return {names[path, name]: camera for path, cameras in read.items() for name, camera in cameras.items()}


def _unique_names(read: Mapping[str, Sequence[str]]) -> dict[tuple[str, str], str]:
    """Find a unique name for each camera. The keys of the result are (path, name in the file)."""
    counts = Counter(name for in_file in read.values() for name in in_file)
    names: dict[tuple[str, str], str] = {}
    used: set[str] = set()
    for path, in_file in read.items():
        for name in in_file:
            unique = name
            if counts[name] > 1:
                unique = Path(path).stem + (f"_{name}" if len(in_file) > 1 else "")
                warn_about(path, f"there are several cameras {name}; this one is renamed to {unique}")
            if unique in used:
                raise CameraError(f"there are two cameras {unique}: rename a file", path=path, key=name)
            used.add(unique)
            names[path, name] = unique
    return names


def _format_or_none(file: CalibrationFile) -> CalibrationFormat | None:
    """Find the first format that recognises a file; None for no format."""
    own = [format for format in READ_FORMATS if format.syntax == file.syntax]
    others = [format for format in READ_FORMATS if file.syntax in format.also]
    return next((format for format in (*own, *others) if format.matches(file)), None)


def _detect_format(file: CalibrationFile) -> CalibrationFormat:
    format = _format_or_none(file)
    if format is not None:
        return format
    content = ""
    if isinstance(file.document, dict):
        keys = ", ".join(str(key)[:30] for key in list(file.document)[:6])
        content = f" Its keys are {keys}." if keys else ""
    if file.document is not None:
        found = find_parameters(plain(file))
        said = missing_parts(found)
        content += f" {said[:1].upper()}{said[1:]}."
        content += other_lens(file)
        if not found.cameras and (numbers := numbers_found(plain(file))):
            content += f" Numbers under unknown keys: {', '.join(numbers)}."
    titles = [one.title for one in (*FORMATS, *READ_FORMATS) if one.syntax == file.syntax]
    known = ", ".join(dict.fromkeys(titles))
    kind = "text" if file.syntax == "text" else file.syntax.upper()
    message = f"is not a known calibration format.{content} Known in {kind}: {known}"
    raise _UnknownFormat(message, path=file.path)


def _sizes(
    path: str, raw: Mapping[str, RawCamera], format: CalibrationFormat, given: ImageSize | None
) -> dict[str, ImageSize]:
    """Find the image size of each camera: the given size, or else the size in the file, or else a size that
    fits the principal points."""
    sizes = {name: given or camera.size for name, camera in raw.items()}
    unknown = [name for name, size in sizes.items() if size is None]
    if unknown:
        points = {name: _principal_point(raw[name]) for name in unknown}
        middle = np.median(list(points.values()), axis=0)
        alike = all((np.abs(p - middle) < _SAME_IMAGE * np.abs(middle)).all() for p in points.values())
        for name, point in points.items():
            sizes[name] = guess_image_size(list(points.values()) if alike else point, format.sizes)
            if not all(_SMALLEST_GUESS <= side <= MAX_SIZE for side in sizes[name] or ()):
                message = (
                    f"the file has no image size for {name}, and its K does not determine it: give the size"
                )
                raise CameraError(message, path=path, key="size")
        guesses = sorted({f"{w}x{h}" for w, h in (sizes[name] or (0, 0) for name in unknown)})
        some = ", ".join(guesses[:3]) + (" …" if len(guesses) > 3 else "")
        warn_about(path, f"the image size is not in the file; {some} is assumed from the principal points")
    return {name: size for name, size in sizes.items() if size is not None}


def _principal_point(raw: RawCamera) -> Array:
    scale = raw.K[2, 2] or 1.0
    with np.errstate(all="ignore"):
        return np.asarray(np.nan_to_num(raw.K[:2, 2] / scale), dtype=float)


def _camera(path: str, name: str, raw: RawCamera, size: ImageSize, unit: float, rotation: Array) -> Camera:
    """Convert a camera to metres and ``map``. Errors name the file, line and key."""
    t = raw.t if raw.center is None else -_orthonormal(raw.rotation) @ raw.center
    rectified = None if raw.rectified is None else raw.rectified * [1, 1, 1, unit]
    rest = (raw.distortion, raw.model, raw.rectification, rectified)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            camera = Camera(size, raw.K, raw.rotation @ rotation.T, t * unit, *rest)
        except CameraError as error:
            part = error.key or ""
            at = raw.locations.get(part) or raw.locations.get("") or SourceLocation()
            key = at.key if part in raw.locations and at.key else ".".join(filter(None, (name, part)))
            raise CameraError(error.message, path=at.path or path, line=at.line, key=key) from None
    messages = [str(warning.message) for warning in caught if issubclass(warning.category, HumansimWarning)]
    for message in (*messages, *(check_focal_length(camera) or check_image_size(camera))):
        warn_about(path, f"{name}: {message}")
    return camera


def _orthonormal(r: Array) -> Array:
    """Correct a rotation matrix as Camera does. A matrix that Camera refuses is returned unchanged."""
    error = np.abs(r @ r.T - np.eye(3)).max()
    return nearest_rotations(r) if 1e-12 < error < 1e-3 else r


# -- URLs


def resolve_url(url: str, name: str | None = None) -> Path:
    """Find the file of a ``camera_info_url`` in the same way as ROS's camera_info_manager.

    A URL is ``file:///…`` or ``package://<package>/…``. In the URL, ``${NAME}`` stands for ``name``, the name
    of the camera. ``${ROS_HOME}`` stands for the environment variable ROS_HOME or, if it is not set, for
    ~/.ros. An empty URL is file://${ROS_HOME}/camera_info/${NAME}.yaml. Packages are searched in
    AMENT_PREFIX_PATH. A path that is not a URL is returned unchanged.

    Raises:
        CameraError: The URL is not valid, or its package is missing.
    """
    text = re.sub(
        r"\$\{([^}]*)\}",
        lambda m: _variable(m[1], url, name),
        url or "file://${ROS_HOME}/camera_info/${NAME}.yaml",
    )
    if text[:7].lower() == "file://":
        if text[7:8] != "/":
            raise CameraError("a file URL needs an absolute path: file:///folder/camera.yaml", key=url)
        return Path(text[7:])
    if text[:10].lower() == "package://":
        package, slash, inside = text[10:].partition("/")
        if not (re.fullmatch(r"\w+", package) and slash and inside):
            raise CameraError("a package URL is package://<package>/<file in its share folder>", key=url)
        return _share_folder(package, url) / inside
    if "://" in text:
        raise CameraError("only file:// and package:// URLs of calibrations can be read", key=url)
    return Path(text)


def _variable(variable: str, url: str, name: str | None) -> str:
    if variable == "ROS_HOME":
        return os.environ.get("ROS_HOME") or str(Path.home() / ".ros")
    if variable == "NAME" and name is not None:
        return name
    known = "NAME and ROS_HOME" if name is not None else "ROS_HOME"
    message = f"${{{variable}}} is not a known variable; known are {known}"
    raise CameraError(message, key=url or "camera_info_url")


def _share_folder(package: str, url: str) -> Path:
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    for prefix in prefixes:
        folder = Path(prefix) / "share" / package
        if folder.is_dir():
            return folder
    if package == "humansim_ros":
        with located(CameraError, key=url):
            return resource_root()
    where = ", ".join(prefixes) if prefixes else "AMENT_PREFIX_PATH, which is empty: source your workspace"
    raise CameraError(f"no package {package}; looked in {where}", key=url)
