"""``humansim camera show`` and ``convert``: the content of calibration files, and other formats."""

from __future__ import annotations

import fnmatch
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from humansim_ros.cli.options import (
    CalibrationArgument,
    CalibrationsArgument,
    CameraOption,
    ImageOption,
    JsonOption,
    SizeOption,
    UnitOption,
    UpOption,
    parse_size,
)
from humansim_ros.cli.output import print_text, to_json
from humansim_ros.errors import CameraError, HumansimWarning

if TYPE_CHECKING:
    from humansim_ros.camera import Camera
    from humansim_ros.camera.calibration import Calibration


def show(
    file: CalibrationArgument,
    as_json: JsonOption = False,
    size: SizeOption = None,
    image: ImageOption = None,
    unit: UnitOption = None,
    up: UpOption = None,
    camera: CameraOption = None,
) -> None:
    """Print the cameras of a calibration: K, lens, pose, field of view, and implausible values."""
    from humansim_ros.camera.checks import check_rig, note_principal_points

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        calibration = load_or_scene(file, size, image, unit, up)
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
    files: CalibrationsArgument,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Output file, or folder for formats of one file per camera."),
    ],
    to: Annotated[
        str | None,
        typer.Option(
            metavar="FORMAT",
            help="Name of the format, such as camera_info, kalibr or colmap; an unknown name prints all. "
            "The suffix of the output decides if absent.",
        ),
    ] = None,
    size: SizeOption = None,
    image: ImageOption = None,
    unit: UnitOption = None,
    up: UpOption = None,
    camera: CameraOption = None,
) -> None:
    """Write the cameras of calibrations in another format. Warns about values that are lost."""
    from humansim_ros.camera.calibration import write_calibration

    cameras = select_cameras(read_cameras(files, size, image, unit, up), camera, files[0])
    for path in write_calibration(output, cameras, to):
        print_text(f"wrote {path}")


def read_cameras(
    files: Sequence[str],
    size: str | None = None,
    image: Path | None = None,
    unit: float | None = None,
    up: str | None = None,
) -> dict[str, Camera]:
    """Read the cameras of calibration files.

    Args:
        files: Files, folders or URLs; also scenes with a rig.
        size: Option ``--size``.
        image: Option ``--image``.
        unit: Option ``--unit``.
        up: Option ``--up``.
    """
    from humansim_ros.camera.calibration import join_calibrations

    return join_calibrations({file: load_or_scene(file, size, image, unit, up).cameras for file in files})


def select_cameras(cameras: dict[str, Camera], patterns: list[str] | None, file: str) -> dict[str, Camera]:
    """Cameras whose names match one of the patterns (``--camera``); all cameras without patterns."""
    if not patterns:
        return cameras
    selected = {n: c for n, c in cameras.items() if any(fnmatch.fnmatchcase(n, p) for p in patterns)}
    if not selected:
        names = ", ".join(list(cameras)[:8])
        raise CameraError(f"no camera is named {' or '.join(patterns)}; the names are {names}", path=file)
    return selected


def describe_camera(name: str, camera: Camera) -> dict[str, Any]:
    """Facts about a camera for ``humansim camera show --json``."""
    import numpy as np

    from humansim_ros.camera.checks import baseline, check_camera, field_of_view

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


def load(file: str, size: str | None, image: Path | None, unit: float | None, up: str | None) -> Calibration:
    """Load a calibration file.

    Args:
        file: File, folder or URL.
        size: Option ``--size``.
        image: Option ``--image``.
        unit: Option ``--unit``.
        up: Option ``--up``.
    """
    from humansim_ros.camera.calibration import load_calibration

    given = None if size is None else parse_size(size)
    return load_calibration(file, size=given, unit=unit, up=up, image=image)


def load_or_scene(
    file: str, size: str | None, image: Path | None, unit: float | None, up: str | None
) -> Calibration:
    """Load a calibration file, or the cameras of a scene with a ``rig``, as ``humansim camera place`` writes.

    Args:
        file: File, folder or URL.
        size: Option ``--size``.
        image: Option ``--image``.
        unit: Option ``--unit``.
        up: Option ``--up``.
    """
    if not _has_rig(file):
        return load(file, size, image, unit, up)
    from humansim_ros.camera.calibration import Calibration
    from humansim_ros.camera.formats.scene import SCENE
    from humansim_ros.scene.config import load_config
    from humansim_ros.scene.rig import build_cameras
    from humansim_ros.scene.source import SceneSource

    if any(option is not None for option in (size, image, unit, up)):
        message = "a scene has size, unit and up axis in its section 'rig': leave these options out"
        raise CameraError(message, path=file)
    config, source = load_config(file), SceneSource.of_file(file)
    with source.locating_errors():
        cameras = {name: camera.camera for name, camera in build_cameras(config, source).items()}
    sizes = {name: camera.size for name, camera in cameras.items()}
    return Calibration(cameras, SCENE, 1.0, "z", sizes, frozenset(cameras))


def _has_rig(file: str) -> bool:
    """Whether a file is a scene with a ``rig``, whose cameras are in another file."""
    from humansim_ros.io.yaml import read_yaml

    if "://" in file or Path(file).suffix.lower() not in (".yaml", ".yml") or not Path(file).is_file():
        return False
    try:
        document, _ = read_yaml(file, CameraError, "scene")
    except CameraError:
        return False  # such as YAML of OpenCV
    return isinstance(document, dict) and isinstance(document.get("rig"), dict)


#: Commands of this module by name.
COMMANDS: dict[str, Callable[..., None]] = {"show": show, "convert": convert}
