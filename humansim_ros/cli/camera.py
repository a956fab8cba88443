"""The ``humansim camera`` commands: read, convert and draw calibrations, ideal cameras, new rigs."""

from __future__ import annotations

import fnmatch
import math
import re
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from humansim_ros.cli.options import parse_size
from humansim_ros.cli.output import check_output, print_text, print_warning, to_json
from humansim_ros.errors import CameraError, HumansimError, HumansimWarning
from humansim_ros.files.reading import make_folder

if TYPE_CHECKING:
    from humansim_ros.cameras.camera import Camera, Ideal
    from humansim_ros.cameras.formats import Calibration


def show(
    file: str,
    extrinsics: list[str] | None = None,
    as_json: bool = False,
    *,
    reading: Reading,
    camera: list[str] | None = None,
) -> None:
    """Print the cameras of a calibration: K, lens, pose, field of view, and implausible values."""
    from humansim_ros.cameras.formats import Calibration, check_rig, note_principal_points

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if len(extrinsics or ()) < 2:
            calibration = reading.load(file, *extrinsics) if extrinsics else reading.load_or_scene(file)
        else:
            joined = reading.cameras([file, *(extrinsics or ())])
            unit, up = reading.unit or 1.0, reading.up or "z"
            calibration = Calibration(joined, None, unit, up, {}, frozenset(joined))
    cameras = select_cameras(calibration.cameras, camera, file)
    described = [describe_camera(name, cam) for name, cam in cameras.items()]
    of_cameras = tuple(f"{cam['name']}: {text}" for cam in described for text in cam["warnings"])
    messages = [str(w.message) for w in caught if issubclass(w.category, HumansimWarning)]
    of_file = [text.removeprefix(f"{file}: ") for text in messages if not text.endswith(of_cameras or "\0")]
    facts = {
        "file": file,
        "form": calibration.format.name if calibration.format else None,
        "unit": calibration.unit,
        "up": calibration.up,
        "cameras": described,
        "warnings": [*of_file, *check_rig(cameras), *note_principal_points(cameras)],
    }
    print_text(to_json(facts) if as_json else "\n".join(_lines(calibration, facts)))


def convert(
    files: list[str],
    output: Path,
    to: str | None = None,
    *,
    reading: Reading,
    camera: list[str] | None = None,
) -> None:
    """Write the cameras of calibrations in another format. Warns about values that are lost."""
    from humansim_ros.cameras.formats import write_calibration

    cameras = select_cameras(reading.cameras(files), camera, files[0])
    for path in write_calibration(output, cameras, to):
        print_text(f"wrote {path}")


def select_cameras(cameras: dict[str, Camera], patterns: list[str] | None, file: str) -> dict[str, Camera]:
    """Select the cameras with names that match one of the patterns (``--camera``). If there are no patterns,
    all cameras."""
    if not patterns:
        return cameras
    selected = {n: c for n, c in cameras.items() if any(fnmatch.fnmatchcase(n, p) for p in patterns)}
    if not selected:
        names = ", ".join(list(cameras)[:8])
        raise CameraError(f"no camera is named {' or '.join(patterns)}; the names are {names}", path=file)
    return selected


def describe_camera(name: str, camera: Camera) -> dict[str, Any]:
    """Collect facts about a camera for ``humansim camera show --json``."""
    import numpy as np

    from humansim_ros.cameras.formats import baseline, check_camera, field_of_view

    view = field_of_view(camera)
    angles = {key: math.degrees(value) for key, value in vars(view).items()}
    radius = camera.lens.valid_radius
    return {
        "name": name,
        "size": list(camera.size),
        "K": camera.K.tolist(),
        "model": camera.model,
        "distortion": list(camera.distortion),
        "R": camera.R.tolist(),
        "t": camera.t.tolist(),
        "center": (camera.center + 0.0).tolist(),
        "P": camera.P.tolist(),
        "rectification": camera.rectification_matrix.tolist(),
        "rectified": camera.rectified_projection.tolist(),
        "rectified_given": camera.rectified is not None or camera.rectification is not None,
        "baseline": baseline(camera) + 0.0,
        "fov_deg": {key: angle if math.isfinite(angle) else None for key, angle in angles.items()},
        "valid_radius": float(radius),
        "valid_angle_deg": float(np.degrees(np.arctan(radius))),
        "warnings": check_camera(camera),
    }


def _lines(calibration: Calibration, facts: dict[str, Any]) -> Iterator[str]:
    count = len(facts["cameras"])
    title = calibration.format.title if calibration.format else "several formats"
    unit = f", unit {calibration.unit:g} m" if calibration.unit != 1 else ""
    up = f", {calibration.up} is up" if calibration.up != "z" else ""
    yield f"{facts['file']}: {title}, {count} camera{'s' * (count != 1)}{unit}{up}"
    for camera in facts["cameras"]:
        yield from _camera_lines(camera)
    for text in facts["warnings"]:
        yield f"! {text}"


def _camera_lines(camera: dict[str, Any]) -> Iterator[str]:
    yield camera["name"]
    width, height = camera["size"]
    view = {key: "?" if v is None else f"{v:.1f}°" for key, v in camera["fov_deg"].items()}
    yield (
        f"  {width}x{height} pixels, field of view {view['horizontal']} across, {view['vertical']} down, "
        f"{view['diagonal']} from corner to corner"
    )
    yield from _matrix_lines("K", camera["K"])
    lens = f"{camera['model']}, no distortion"
    if any(camera["distortion"]) or camera["model"] == "equidistant":
        lens = f"{camera['model']} {_row(camera['distortion'])}"
        lens += f", valid to {camera['valid_angle_deg']:.1f}° off the axis"
    yield f"  lens   {lens}"
    yield from _matrix_lines("R", camera["R"])
    yield f"  t      {_row(camera['t'])}"
    yield f"  centre {_row(camera['center'])}  (map, metres)"
    yield from _matrix_lines("P", camera["P"])
    if camera["rectified_given"]:
        yield from _matrix_lines("rect R", camera["rectification"])
        yield from _matrix_lines("rect P", camera["rectified"])
    if camera["baseline"]:
        yield f"  stereo {camera['baseline']:.6g} m to the right of the first camera"
    for text in camera["warnings"]:
        yield f"  ! {text}"


def _matrix_lines(name: str, matrix: list[list[float]]) -> Iterator[str]:
    for index, values in enumerate(matrix):
        yield f"  {name if index == 0 else '':6} " + " ".join(f"{value:12.6g}" for value in values)


def _row(values: Sequence[float]) -> str:
    return " ".join(f"{value:.6g}" for value in values)


@dataclass(frozen=True)
class Reading:
    """Options of the command line for reading calibration files. Each attribute has the name of its option
    (``size`` for ``--size``)."""

    size: str | None = None
    image: Path | None = None
    unit: float | None = None
    up: str | None = None

    def load(self, file: str, extrinsics: str | None = None) -> Calibration:
        """Load a calibration file, folder or URL. ``extrinsics``: file with extrinsics, if ``file`` has
        none."""
        from humansim_ros.cameras.formats import load_calibration

        size = None if self.size is None else parse_size(self.size)
        return load_calibration(
            file, size=size, unit=self.unit, up=self.up, image=self.image, extrinsics=extrinsics
        )

    def load_or_scene(self, file: str) -> Calibration:
        """Load a calibration file; or, if the file is a scene with a ``rig`` (from ``camera place``), its
        cameras."""
        if not _has_rig(file):
            return self.load(file)
        from humansim_ros.cameras.formats import SCENE, Calibration
        from humansim_ros.scene.config import load_config
        from humansim_ros.scene.core import SceneSource, build_cameras
        from humansim_ros.scene.features import read_robot

        if any(option is not None for option in vars(self).values()):
            message = "a scene has size, unit and up axis in its section 'rig': leave these options out"
            raise CameraError(message, path=file)
        config, source = load_config(file), SceneSource.of_file(file)
        with source.locating_errors():
            built = build_cameras(config, source, read_robot(config, source))
            cameras = {name: camera.camera for name, camera in built.items()}
        sizes = {name: camera.size for name, camera in cameras.items()}
        return Calibration(cameras, SCENE, 1.0, "z", sizes, frozenset(cameras))

    def cameras(self, files: Sequence[str]) -> dict[str, Camera]:
        """Load cameras from calibrations and scenes with a rig, or from pairs of files with intrinsics and
        extrinsics."""
        from humansim_ros.cameras.formats import has_only_extrinsics, join_calibrations, paired

        outer = [file for file in files if len(files) % 2 == 0 and has_only_extrinsics(file)]
        inner = [file for file in files if file not in outer]
        if outer and len(inner) == len(outer):
            return join_calibrations({a: self.load(a, b).cameras for a, b in paired(inner, outer)})
        return join_calibrations({file: self.load_or_scene(file).cameras for file in files})


def _has_rig(file: str) -> bool:
    """Whether a file is a scene with a ``rig``, so that its cameras are in another file."""
    from humansim_ros.files.yaml import read_yaml

    if "://" in file or Path(file).suffix.lower() not in (".yaml", ".yml") or not Path(file).is_file():
        return False
    try:
        document, _ = read_yaml(file, CameraError, "scene")
    except CameraError:
        return False  # such as YAML of OpenCV
    return isinstance(document, dict) and isinstance(document.get("rig"), dict)


_JPEG = (".jpg", ".jpeg")
#: Distance between cameras and walls, metres, so that furniture fits in between.
_WALL_DISTANCE = 1.3
#: Smallest room and longest side of a room, metres.
_ROOM, _LARGEST_ROOM = (7.0, 6.4, 2.8), 100.0
#: Radius of the circle of the built-in motion ``walk``, and smallest radius of a rig around it, metres.
_WALK_RADIUS, _WALK_RIG_RADIUS = 1.59, 3.0


def idealize(
    file: str,
    output: Path,
    images: list[Path] | None = None,
    square: bool = False,
    keep_center: bool = False,
    fit: Literal["focal", "all", "no_black"] = "focal",
    nearest: bool = False,
    *,
    reading: Reading,
    camera: list[str] | None = None,
) -> None:
    """Convert cameras and images to ideal cameras: no distortion, no skew, a centred principal point."""
    from humansim_ros.cameras.camera import idealize as make_ideal

    calibration = reading.load(file)
    real = select_cameras(calibration.cameras, camera, file)
    if images and len(real) != 1:
        names = ", ".join(list(real)[:8])
        raise CameraError(f"choose the camera of the images with --camera: one of {names}", path=file)
    ideals = {name: make_ideal(one, square, not keep_center, fit) for name, one in real.items()}
    make_folder(output)
    _write_ideal(file, output, calibration, {name: ideal.camera for name, ideal in ideals.items()})
    _convert_images(next(iter(ideals.values())), images or [], output, nearest)


@dataclass(frozen=True)
class RigLayout:
    """Options of ``rig`` that choose a layout. Each attribute has the name of its option."""

    ring: int | None = None
    grid: str | None = None
    dome: int | None = None
    stereo: float | None = None


@dataclass(frozen=True)
class RigOptics:
    """Options of ``rig`` about the cameras. Each attribute has the name of its option."""

    size: str = "640x480"
    fov_deg: float = 60.0
    distortion: str | None = None
    model: Literal["plumb_bob", "rational_polynomial", "equidistant"] | None = None


def rig(
    output: Path,
    *,
    layout: RigLayout,
    radius: float = 4.0,
    height: float | None = None,
    look_at: tuple[float, float, float] = (0.0, 0.0, 1.0),
    start_deg: float = 0.0,
    spacing: float = 0.5,
    optics: RigOptics,
) -> None:
    """Arrange cameras around a target. Writes a scene for `humansim run`, and camera_info files."""
    from humansim_ros.cameras.camera import rigs

    layouts = {f"--{name}": value for name, value in vars(layout).items()}
    given = [option for option, value in layouts.items() if value is not None]
    if len(given) != 1:
        raise HumansimError(
            f"give one of {', '.join(layouts)}" + (f", not {' and '.join(given)}" if given else "")
        )
    if layout.dome is not None and height is not None:
        raise HumansimError("--height: a dome starts at the height of its target (--look-at)")
    numbers = (*look_at, start_deg, optics.fov_deg, spacing, radius, height or 0.0)
    if not all(map(math.isfinite, numbers)):
        raise HumansimError("the options must be finite numbers")
    lens = (_coefficients(optics.distortion), optics.model)
    rig = rigs.Rig(
        look_at,
        radius,
        1.8 if height is None else height,
        rigs.Optics(parse_size(optics.size), math.radians(optics.fov_deg), *lens),
        math.radians(start_deg),
    )
    if layout.ring is not None:
        cameras = rig.ring(layout.ring)
    elif layout.grid is not None:
        cameras = rig.grid(*_rows_columns(layout.grid), spacing)
    elif layout.dome is not None:
        cameras = rig.dome(layout.dome)
    else:
        assert layout.stereo is not None
        cameras = rig.stereo(layout.stereo)
    _write_rig(output, cameras, look_at, radius)


def plot(
    files: list[str],
    output: Path,
    coverage: bool = False,
    height: float = 1.2,
    stature: float = 1.8,
    area: tuple[float, float, float, float] | None = None,
    *,
    reading: Reading,
    camera: list[str] | None = None,
) -> None:
    """Draw the cameras of calibrations from above and from the side, or their coverage of the floor."""
    from humansim_ros.render.pictures import write_png
    from humansim_ros.scene.pictures import coverage_image, rig_image

    check_output(output, ".png")
    cameras = select_cameras(reading.cameras(files), camera, files[0])
    _warn_of_one_position(cameras)
    drawing = coverage_image(cameras, height, stature, area) if coverage else rig_image(cameras)
    write_png(output, drawing)
    print_text(f"wrote {output}")


# -- idealize


def _write_ideal(file: str, output: Path, read: Calibration, cameras: Mapping[str, Camera]) -> None:
    """Write the ideal cameras in the format of the file of the real cameras."""
    from humansim_ros.cameras.formats import resolve_url, write_calibration

    source = resolve_url(file) if "://" in file else Path(file)
    several = source.is_dir() or (read.format is not None and read.format.name == "colmap")
    target = output / (source.name if read.format is not None else "cameras.yaml")
    if several and read.format is not None:
        target = output
    _refuse_to_overwrite(source, target)
    for path in write_calibration(target, cameras, read.format.name if read.format else "scene"):
        print_text(f"wrote {path}")


def _convert_images(ideal: Ideal, images: list[Path], output: Path, nearest: bool) -> None:
    """Convert images to the ideal cameras, and write them to a folder. Failed images are reported."""
    names: set[str] = set()
    failed = False
    for path in images:
        try:
            if path.name in names:
                raise CameraError("another image of this name has already been written", path=path)
            _refuse_to_overwrite(path, output / path.name)
            _convert_image(ideal, path, output / path.name, nearest)
        except HumansimError as error:
            failed = True
            print(f"error: {error}", file=sys.stderr)
        else:
            names.add(path.name)
            print_text(f"wrote {output / path.name}")
    if failed:
        raise typer.Exit(2)


def _convert_image(ideal: Ideal, path: Path, target: Path, nearest: bool) -> None:
    import cv2
    import numpy as np

    from humansim_ros.cameras.formats import image_size
    from humansim_ros.files.reading import MAX_IMAGE_BYTES, read_bytes, write_file

    if path.suffix.lower() not in (".png", *_JPEG):
        raise CameraError("images are .png or .jpg", path=path)
    size, expected = image_size(path), ideal.real.size
    if size != expected:
        message = f"the image is {size[0]}x{size[1]} pixels, but the camera has {expected[0]}x{expected[1]}"
        raise CameraError(message, path=path, key="size")
    data = np.frombuffer(read_bytes(path, CameraError, "image", MAX_IMAGE_BYTES), np.uint8)
    try:
        image: Any = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.shape[:2] != expected[::-1]:
        raise CameraError("the image cannot be decoded: it is damaged", path=path)
    converted = ideal.to_ideal(image, cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 95] if path.suffix.lower() in _JPEG else []
    encoded, content = cv2.imencode(path.suffix, converted, quality)
    if not encoded:
        raise CameraError("the converted image cannot be encoded", path=path)
    write_file(target, content.tobytes())


def _refuse_to_overwrite(source: Path, target: Path) -> None:
    if source.resolve() == target.resolve():
        raise HumansimError("would be overwritten: give another folder with --output", path=source)


# -- rig


def _coefficients(text: str | None) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in (text or "").replace(",", " ").split())
    except ValueError:
        raise HumansimError(f"--distortion: needs numbers, such as '-0.3 0.1 0 0', not {text!r}") from None


def _rows_columns(text: str) -> tuple[int, int]:
    matched = re.fullmatch(r"([0-9]{1,4})\s*[x×,]\s*([0-9]{1,4})", text.strip(), re.ASCII)
    if matched is None:
        raise HumansimError(f"--grid: needs rows and columns, such as 2x4, not {text!r}")
    return int(matched[1]), int(matched[2])


def _write_rig(
    output: Path, cameras: Mapping[str, Camera], look_at: tuple[float, float, float], radius: float
) -> None:
    """Write scene.yaml with the cameras, and camera_info files without poses."""
    from humansim_ros.cameras.formats import SCENE, write_calibration
    from humansim_ros.files.reading import write_file

    folder = output / "camera_info"
    make_folder(folder)
    low = min(camera.center[2] for camera in cameras.values())
    if low <= 0:
        print_warning(f"the lowest camera is {-low:.2f} m below the floor")
    scene = output / "scene.yaml"
    text = _scene_text(cameras, look_at, radius) + str(SCENE.write(cameras)[""])
    write_file(scene, text)
    print_text(f"wrote {scene}; try: humansim run {scene}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # camera_info does not store poses, but the scene does
        for path in write_calibration(folder, cameras, "camera_info"):
            print_text(f"wrote {path}")


def _scene_text(cameras: Mapping[str, Camera], look_at: tuple[float, float, float], radius: float) -> str:
    """Text of a scene file with a room around all cameras, and a human."""
    x, y, _ = look_at
    if radius >= _WALK_RIG_RADIUS:
        motion = f"{{file: walk, position: [{x:g}, {y - _WALK_RADIUS:g}], loop: continue}}"
    else:
        motion = f"{{file: wave, position: [{x:g}, {y:g}], anchor: center}}"
    room = room_around(cameras, (x, y))
    return f"rate: 30\nroom: {room}\nhumans:\n  walker: {{motion: {motion}}}\n"


def room_around(cameras: Mapping[str, Camera], target: tuple[float, float]) -> str:
    """Value of a scene's ``room``: it contains all cameras and a person who walks around ``target``."""
    x, y = target
    centers = [camera.center.tolist() for camera in cameras.values()]
    within = [
        *centers,
        (x - _WALK_RADIUS, y - _WALK_RADIUS),
        (x + _WALK_RADIUS, y + _WALK_RADIUS),
    ]
    sides = [2 * (max(abs(position[axis]) for position in within) + _WALL_DISTANCE) for axis in (0, 1)]
    needed = (*sides, max(center[2] for center in centers) + 0.3)
    size = [round(max(pair), 1) for pair in zip(_ROOM, needed, strict=True)]
    return "null" if max(size) > _LARGEST_ROOM else f"{{size: {size}}}"


# -- plot


def _warn_of_one_position(cameras: Mapping[str, Camera]) -> None:
    centers = {tuple(camera.center.tolist()) for camera in cameras.values()}
    if len(cameras) > 1 and len(centers) == 1:
        print_warning("all cameras are at one position: do the files have extrinsics?")
