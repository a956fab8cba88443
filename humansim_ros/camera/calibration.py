"""Calibration files, found by content, into cameras and back: x_cam = R x_world + t in metres, in ``map``.

docs/cameras.md lists the forms and what each one means by its numbers; their readers are in formats/.
"""

from __future__ import annotations

import os
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from humansim_ros.camera.camera import MAX_SIZE, Camera
from humansim_ros.camera.checks import check_image_size
from humansim_ros.camera.formats import FORMATS, CalibrationFormat, CalibrationSource, FilePosition, RawCamera
from humansim_ros.camera.formats.colmap import CAMERAS, IMAGES
from humansim_ros.camera.formats.colmap import MAX_BYTES as MAX_BYTES_COLMAP
from humansim_ros.camera.formats.containers import container_of, parsed
from humansim_ros.camera.image_size import image_size, likely_size
from humansim_ros.errors import CameraError, HumansimWarning, ResourceError, warn_about
from humansim_ros.io.files import atomic_path, exists, read_text
from humansim_ros.resources import resource_root
from humansim_ros.types import Array, ImageSize

#: Turns of a file's world into one whose z is up, by the axis that is up in the file: the shortest ones.
UPRIGHT: Mapping[str, Array] = {
    "z": np.eye(3),
    "-z": np.diag([1.0, -1.0, -1.0]),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "-y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "x": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "-x": np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
}
_MAX_BYTES = 8 << 20
#: Files of a folder that can be calibrations.
_SUFFIXES = (".yaml", ".yml", ".json", ".xml", ".ini", ".txt", ".cam", ".krtd")
#: Of several principal points, how far those of equal images are from their median.
_SAME_IMAGE = 0.25
_SMALLEST_GUESS = 16
_SKEW_SLACK = 1e-9


@dataclass(frozen=True)
class Calibration:
    """What :func:`read_calibration` reads: ``cameras`` by name, and what the file was taken for.

    ``form``: its form, None for a folder of files. ``unit``: metres per unit; ``up``: its axis that points
    up. ``sizes``: (width, height) of those cameras whose image size is in the file.
    """

    cameras: dict[str, Camera]
    form: CalibrationFormat | None
    unit: float
    up: str
    sizes: dict[str, ImageSize]


class _UnknownFormat(CameraError):
    """Not wrong in itself, but no calibration."""


def read_calibration(
    path: str | os.PathLike[str],
    *,
    size: ImageSize | None = None,
    unit: float | None = None,
    up: str | None = None,
    image: str | os.PathLike[str] | None = None,
) -> dict[str, Camera]:
    """The cameras of a calibration file, by name, in the file's order.

    ``path``: a file of any known form, a folder with such files or with a COLMAP model, or a URL as
    :func:`resolve_url` takes. ``size``: (width, height) of the images, for forms that do not say it (and in
    place of what the file says); ``image``: a PNG or JPEG that has this size. Without either, a size that
    fits the principal points is assumed with a HumansimWarning. ``unit``: metres per unit of the file,
    ``up``: its axis that points up ("z", "-y" …), where they are not as the form implies.

    A file without extrinsics gives cameras at the origin that look along +z. Raises CameraError with file,
    and key or line.
    """
    return load_calibration(path, size=size, unit=unit, up=up, image=image).cameras


def load_calibration(
    path: str | os.PathLike[str],
    *,
    size: ImageSize | None = None,
    unit: float | None = None,
    up: str | None = None,
    image: str | os.PathLike[str] | None = None,
) -> Calibration:
    """As :func:`read_calibration`, with what the file was taken for."""
    if unit is not None and not 0 < unit < np.inf:
        raise CameraError("the unit must be above zero metres", key="unit")
    if up is not None and up not in UPRIGHT:
        raise CameraError(f"{up!r} is no axis: say x, y, z, -x, -y or -z", key="up")
    if image is not None and size is None:
        size = image_size(image)
    if size is not None and not all(0 < side <= MAX_SIZE for side in size):
        message = f"the image size must be 1 to {MAX_SIZE} pixels, not {size[0]}x{size[1]}"
        raise CameraError(message, key="size")
    file = resolve_url(path) if isinstance(path, str) and "://" in path else Path(path)
    if exists(file) and file.is_dir() and (file / CAMERAS).is_file():
        file = file / (IMAGES if (file / IMAGES).is_file() else CAMERAS)
    if exists(file) and file.is_dir():
        return _folder(file, size, unit, up)
    most = MAX_BYTES_COLMAP if file.name in (CAMERAS, IMAGES) else _MAX_BYTES
    text = read_text(file, CameraError, "calibration", most)
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    source, form = _recognised(str(file), text)
    raw = form.read(source)
    unit, up = form.unit if unit is None else unit, form.up if up is None else up
    sizes = _sizes(source.path, raw, form, size)
    cameras = {name: _camera(source.path, name, raw[name], sizes[name], unit, UPRIGHT[up]) for name in raw}
    said = {name: camera.size for name, camera in raw.items() if camera.size is not None}
    return Calibration(cameras, form, unit, up, said)


def _folder(folder: Path, size: ImageSize | None, unit: float | None, up: str | None) -> Calibration:
    """All calibrations of a folder."""
    try:
        files = sorted(f for f in folder.iterdir() if f.suffix.lower() in _SUFFIXES and f.is_file())
    except OSError as reason:
        raise CameraError(f"cannot read the folder: {reason.strerror}", path=folder) from None
    # of a pair, the first half reads the second
    files = [
        f for f in files if not ("extri" in f.name and f.with_name(f.name.replace("extri", "intri")) in files)
    ]
    read: dict[Path, Calibration] = {}
    for file in files:
        try:
            read[file] = load_calibration(file, size=size, unit=unit, up=up)
        except _UnknownFormat:
            warn_about(file, "no calibration that is known here: left out")
    if not read:
        hint = "its cameras.bin can be read after colmap model_converter --output_type TXT"
        binary = f"; {hint}" if (folder / "cameras.bin").is_file() else ""
        raise CameraError(f"no calibration in this folder ({', '.join(_SUFFIXES)}){binary}", path=folder)
    names = _own_names({str(file): list(calibration.cameras) for file, calibration in read.items()})
    cameras, said = {}, {}
    for file, calibration in read.items():
        for name, camera in calibration.cameras.items():
            own = names[str(file), name]
            cameras[own] = camera
            if name in calibration.sizes:
                said[own] = calibration.sizes[name]
    first = next(iter(read.values()))
    alike = all(calibration.form is first.form for calibration in read.values())
    return Calibration(cameras, first.form if alike else None, first.unit, first.up, said)


def joined(read: Mapping[str, Mapping[str, Camera]]) -> dict[str, Camera]:
    """The cameras of several files, by file, as one rig.

    Cameras of the same name are called by their files, with a HumansimWarning. Raises CameraError where
    these are the same too.
    """
    names = _own_names({path: list(found) for path, found in read.items()})
    return {names[path, name]: camera for path, found in read.items() for name, camera in found.items()}


def _own_names(read: Mapping[str, Sequence[str]]) -> dict[tuple[str, str], str]:
    """A name of its own for each camera of each file."""
    counts = Counter(name for found in read.values() for name in found)
    names: dict[tuple[str, str], str] = {}
    taken: set[str] = set()
    for path, found in read.items():
        for name in found:
            own = name
            if counts[name] > 1:
                own = Path(path).stem + (f"_{name}" if len(found) > 1 else "")
                warn_about(path, f"there are several cameras {name}; this one is called {own}")
            if own in taken:
                raise CameraError(f"there are two cameras {own}: rename a file", path=path, key=name)
            taken.add(own)
            names[path, name] = own
    return names


def _recognised(path: str, text: str) -> tuple[CalibrationSource, CalibrationFormat]:
    container = container_of(path, text)
    source = parsed(path, text, container)
    for form in FORMATS:
        if form.container == container and form.matches(source):
            return source, form
    known = ", ".join(form.title for form in FORMATS if form.container == container)
    found = ""
    if isinstance(source.document, dict):
        keys = ", ".join(str(key)[:30] for key in list(source.document)[:6])
        found = f" It has {keys}." if keys else ""
    kind = "text" if container == "text" else container.upper()
    raise _UnknownFormat(f"no calibration that is known here.{found} Known in {kind}: {known}", path=path)


def _sizes(
    path: str, raw: Mapping[str, RawCamera], form: CalibrationFormat, said: ImageSize | None
) -> dict[str, ImageSize]:
    """Image sizes: as the user says, else as the file does, else as the principal points let one think."""
    sizes = {name: said or camera.size for name, camera in raw.items()}
    unknown = [name for name, size in sizes.items() if size is None]
    if unknown:
        points = {name: _principal_point(raw[name]) for name in unknown}
        middle = np.median(list(points.values()), axis=0)
        near = all((np.abs(p - middle) < _SAME_IMAGE * np.abs(middle)).all() for p in points.values())
        for name, point in points.items():
            sizes[name] = likely_size(list(points.values()) if near else point, form.sizes)
            if not all(_SMALLEST_GUESS <= side <= MAX_SIZE for side in sizes[name] or ()):
                message = f"the file does not say the image size of {name}, and its K does not tell: give it"
                raise CameraError(message, path=path, key="size")
        guesses = sorted({f"{w}x{h}" for w, h in (sizes[name] or (0, 0) for name in unknown)})
        some = ", ".join(guesses[:3]) + (" …" if len(guesses) > 3 else "")
        warn_about(path, f"the image size is not in the file; {some} is assumed from the principal points")
    return {name: size for name, size in sizes.items() if size is not None}


def _principal_point(raw: RawCamera) -> Array:
    scale = raw.K[2, 2] or 1.0
    with np.errstate(all="ignore"):
        return np.asarray(np.nan_to_num(raw.K[:2, 2] / scale), dtype=float)


def _camera(path: str, name: str, raw: RawCamera, size: ImageSize, unit: float, upright: Array) -> Camera:
    """A camera in metres and ``map``; what is wrong with it is told by file and place."""
    t = raw.t if raw.center is None else -_orthonormal(raw.R) @ raw.center
    rectified = None if raw.rectified is None else raw.rectified * [1, 1, 1, unit]
    rest = (raw.distortion, raw.model, raw.rectification, rectified)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            camera = Camera(size, raw.K, raw.R @ upright.T, t * unit, *rest)
        except CameraError as error:
            part = error.key or ""
            place = raw.places.get(part) or raw.places.get("") or FilePosition()
            key = place.key if part in raw.places and place.key else ".".join(filter(None, (name, part)))
            message = (
                "R mirrors (its determinant is -1): no camera does" if _mirrors(raw, part) else error.message
            )
            raise CameraError(message, path=place.path or path, line=place.line, key=key) from None
    odd = [str(warning.message) for warning in caught if issubclass(warning.category, HumansimWarning)]
    for message in (*odd, *check_image_size(camera)):
        warn_about(path, f"{name}: {message}")
    return camera


def _mirrors(raw: RawCamera, part: str) -> bool:
    matrix = {"R": raw.R, "rectification": raw.rectification}.get(part)
    if matrix is None:
        return False
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-3)


def _orthonormal(r: Array) -> Array:
    """The rotation that Camera will make of a matrix; one that is none is left for it to refuse."""
    off = np.abs(r @ r.T - np.eye(3)).max()
    if not 1e-12 < off < 1e-3:
        return r
    u, _, vt = np.linalg.svd(r)
    return np.asarray(u @ vt, dtype=float)


# -- URLs


def resolve_url(url: str, name: str | None = None) -> Path:
    """The file of a ``camera_info_url``, as ROS's camera_info_manager finds it.

    ``file:///…`` or ``package://<package>/…``, with ``${NAME}`` for the camera's ``name`` and ``${ROS_HOME}``
    for that variable or ~/.ros. An empty URL is file://${ROS_HOME}/camera_info/${NAME}.yaml. Packages are
    found in AMENT_PREFIX_PATH; our own without it. A plain path stays as it is. Raises CameraError.
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
    raise CameraError(f"${{{variable}}} is not known here, only {known}", key=url or "camera_info_url")


def _share_folder(package: str, url: str) -> Path:
    prefixes = [p for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    for prefix in prefixes:
        folder = Path(prefix) / "share" / package
        if folder.is_dir():
            return folder
    if package == "humansim_ros":
        try:
            return resource_root()
        except ResourceError as error:
            raise CameraError(error.message, key=url) from None
    where = ", ".join(prefixes) if prefixes else "AMENT_PREFIX_PATH, which is empty: source your workspace"
    raise CameraError(f"no package {package}; looked in {where}", key=url)


# -- writing


def write_calibration(
    path: str | os.PathLike[str], cameras: Mapping[str, Camera], form: str | None = None
) -> list[Path]:
    """Write cameras in a form, whole or not at all.

    ``form``: a name of :data:`FORMATS`; by default from the suffix of ``path``. ``path``: a file; a folder
    for COLMAP, and, without a suffix, for forms of one camera per file. Returns the files. What the form
    cannot hold is refused where it would change what the cameras see, and else told with a HumansimWarning.
    Raises CameraError.
    """
    target = Path(path)
    chosen = _format_of(target, form, len(cameras))
    if not cameras:
        raise CameraError("there is no camera to write", path=target)
    fitting = {name: _fitted(target, name, camera, chosen) for name, camera in cameras.items()}
    turn = UPRIGHT[chosen.up]
    own = {n: replace(c, R=c.R @ turn, t=c.t / chosen.unit) for n, c in fitting.items()}
    texts = _texts(target, own, chosen)
    for message in _losses(cameras, chosen):
        warn_about(target, message)
    for file in texts:
        if file.is_dir():
            raise CameraError("cannot be written: this is a folder", path=file)
    try:
        if len(texts) > 1 or next(iter(texts)).parent == target:
            target.mkdir(exist_ok=True)
        with ExitStack() as stack:
            for file, text in texts.items():
                stack.enter_context(atomic_path(file)).write_text(text, encoding="utf-8")
    except (OSError, UnicodeEncodeError) as reason:
        why = reason.strerror if isinstance(reason, OSError) else "a name has half a character in it"
        raise CameraError(f"cannot be written: {why or reason}", path=target) from None
    return list(texts)


def _format_of(target: Path, name: str | None, count: int) -> CalibrationFormat:
    names = {form.name: form for form in FORMATS}
    if name is not None:
        if name not in names:
            raise CameraError(f"there is no form {name!r}, only {', '.join(names)}", path=target)
        return names[name]
    suffix = target.suffix.lower()
    if suffix == ".txt" and target.stem.endswith("par"):
        return names["middlebury"]
    fitting = [form for form in FORMATS if form.suffix == suffix and suffix]
    if suffix in (".yaml", ".txt", ".yml") and fitting and (count == 1 or fitting[0].several):
        return fitting[0]
    if len(fitting) != 1:
        several = [form.name for form in fitting or FORMATS if form.several or count == 1]
        raise CameraError(f"say which form is to be written: {', '.join(several)}", path=target)
    return fitting[0]


def _fitted(path: Path, name: str, camera: Camera, form: CalibrationFormat) -> Camera:
    """The same camera in a lens model that the form has. Raises CameraError where there is none."""
    if not form.holds_skew and abs(camera.K[0, 1]) > _SKEW_SLACK * camera.K[0, 0]:
        raise _cannot(path, name, form, "skew")
    held = dict(form.lenses)
    model, d = str(camera.model), camera.distortion
    if not camera.distorted:
        return camera if model in held else replace(camera, distortion=(), model="plumb_bob")
    if model == "rational_polynomial" and model not in held and not any(d[5:]):
        model, d = "plumb_bob", d[:5]
    if model not in held:
        raise _cannot(path, name, form, f"{model} distortion")
    if any(d[held[model] :]):
        raise _cannot(path, name, form, f"{model} distortion with more than {held[model]} coefficients")
    return replace(camera, distortion=d, model=model)


def _cannot(path: Path, name: str, form: CalibrationFormat, what: str) -> CameraError:
    hint = "idealize the camera first (humansim camera idealize), or take another form"
    return CameraError(f"{form.title} cannot hold {what}: {hint}", path=path, key=name)


def _losses(cameras: Mapping[str, Camera], form: CalibrationFormat) -> Iterator[str]:
    """What a reader of the files will not know."""
    if not form.holds_pose:
        posed = [n for n, c in cameras.items() if not (np.array_equal(c.R, np.eye(3)) and not c.t.any())]
        if posed:
            yield f"{form.title} does not hold where cameras stand: R and t of {_some(posed)} are left out"
    if not form.holds_size:
        sizes = sorted({"{}x{}".format(*camera.size) for camera in cameras.values()})
        yield f"{form.title} does not hold the image size: say {_some(sizes)} when it is read"
    if not form.holds_rectified:
        stereo = [n for n, c in cameras.items() if c.rectification is not None or c.rectified is not None]
        if stereo:
            yield f"{form.title} does not hold R and P of rectified images: {_some(stereo)} is without them"


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def _texts(target: Path, cameras: Mapping[str, Camera], form: CalibrationFormat) -> dict[Path, str]:
    """Text of each file."""
    try:
        if form.several or (len(cameras) == 1 and target.suffix and not target.is_dir()):
            texts = form.write(cameras)
            if "" in texts:
                file = target / f"cameras{form.suffix}" if target.is_dir() else target
                return {file: texts[""]}
            if target.exists() and not target.is_dir():
                raise CameraError(f"{form.title} is a folder, and this is a file", path=target)
            # an empty file is only there because readers ask for it
            return {target / n: text for n, text in texts.items() if text or not (target / n).exists()}
        if target.suffix and not target.is_dir():
            message = f"{form.title} is a file per camera: name a folder for {len(cameras)} cameras"
            raise CameraError(message, path=target)
        files: dict[Path, str] = {}
        for name, camera in cameras.items():
            file = target / f"{re.sub(r'[^A-Za-z0-9_.-]', '_', name).lstrip('.') or '_'}{form.suffix}"
            if file in files:
                raise CameraError(f"two cameras would be written to {file.name}", path=target, key=name)
            files[file] = form.write({name: camera})[""]
        return files
    except CameraError as error:
        if error.path is not None:
            raise
        raise CameraError(error.message, path=target, key=error.key) from None
