"""The ``humansim camera`` commands: what is in a calibration file, and the same cameras in another form."""

from __future__ import annotations

import fnmatch
import math
import re
import warnings
from collections.abc import Iterator, Sequence
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from humansim_ros.cli.output import say, to_json
from humansim_ros.errors import CameraError, HumansimError, HumansimWarning

if TYPE_CHECKING:
    from humansim_ros.camera import Camera
    from humansim_ros.camera.calibration import Calibration

app = typer.Typer(help="Look at calibrations, convert them, make rigs of cameras.", no_args_is_help=True)


class FormatName(Enum):
    camera_info = "camera_info"
    ini = "ini"
    kalibr = "kalibr"
    scene = "scene"
    human36m = "human36m"
    panoptic = "panoptic"
    shelf = "shelf"
    opencv = "opencv"
    opencv_xml = "opencv_xml"
    opencv_json = "opencv_json"
    cam = "cam"
    colmap = "colmap"
    middlebury = "middlebury"
    krtd = "krtd"
    p = "p"


File = Annotated[str, typer.Argument(help="A calibration file of any form, a folder of them, or a URL.")]
Files = Annotated[list[str], typer.Argument(help="Calibration files of any form, folders, or URLs.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]
Size = Annotated[
    str | None, typer.Option(help="Size of the images, such as 640x480, in place of what the file says.")
]
Image = Annotated[Path | None, typer.Option(help="An image (.png, .jpg) of the size of the camera's.")]
Unit = Annotated[
    float | None, typer.Option(help="Metres per unit of the file; as its form has it if absent.")
]
Up = Annotated[
    str | None, typer.Option(help="The file's axis that points up, such as y or -z; as its form has it.")
]
Only = Annotated[
    list[str] | None, typer.Option("--camera", help="Only cameras of this name, such as left or 'S9_*'.")
]


@app.command()
def show(
    file: File,
    as_json: Json = False,
    size: Size = None,
    image: Image = None,
    unit: Unit = None,
    up: Up = None,
    camera: Only = None,
) -> None:
    """What a calibration says: K, lens, where cameras stand, how wide they see, and what looks wrong."""
    from humansim_ros.camera.checks import check_rig

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        calibration = load(file, size, image, unit, up)
    cameras = chosen(calibration.cameras, camera, file)
    described = [describe_camera(name, cam) for name, cam in cameras.items()]
    of_cameras = tuple(f"{cam['name']}: {text}" for cam in described for text in cam["warnings"])
    odd = [str(w.message) for w in caught if issubclass(w.category, HumansimWarning)]
    odd = [text.removeprefix(f"{file}: ") for text in odd if not text.endswith(of_cameras or "\0")]
    facts = {
        "file": file,
        "form": calibration.format.name if calibration.format else None,
        "unit": calibration.unit,
        "up": calibration.up,
        "cameras": described,
        "warnings": [*odd, *check_rig(cameras)],
    }
    say(to_json(facts) if as_json else "\n".join(_lines(calibration, facts)))


@app.command()
def convert(
    files: Files,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="The file, or the folder for forms of one file per camera.")
    ],
    to: Annotated[
        FormatName | None, typer.Option(help="Which form; by the suffix of the output if absent.")
    ] = None,
    size: Size = None,
    image: Image = None,
    unit: Unit = None,
    up: Up = None,
    camera: Only = None,
) -> None:
    """Write the cameras of calibrations in another form; what it cannot hold is said."""
    from humansim_ros.camera.calibration import write_calibration

    cameras = chosen(read_cameras(files, size, image, unit, up), camera, files[0])
    for path in write_calibration(output, cameras, to.value if to else None):
        say(f"wrote {path}")


def read_cameras(
    files: Sequence[str],
    size: str | None = None,
    image: Path | None = None,
    unit: float | None = None,
    up: str | None = None,
) -> dict[str, Camera]:
    """The cameras of calibration files, with the options that all commands have."""
    from humansim_ros.camera.calibration import join_calibrations

    return join_calibrations({file: load(file, size, image, unit, up).cameras for file in files})


def chosen(cameras: dict[str, Camera], patterns: list[str] | None, file: str) -> dict[str, Camera]:
    """Those cameras whose names match one of the patterns; all without patterns."""
    if not patterns:
        return cameras
    found = {n: c for n, c in cameras.items() if any(fnmatch.fnmatchcase(n, p) for p in patterns)}
    if not found:
        names = ", ".join(list(cameras)[:8])
        raise CameraError(f"no camera is named {' or '.join(patterns)}; there is {names}", path=file)
    return found


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of text such as 640x480."""
    matched = re.fullmatch(r"([0-9]{1,6})\s*[x×,]\s*([0-9]{1,6})", text.strip(), re.ASCII)
    if matched is None:
        raise HumansimError(f"--size: needs width and height, such as 640x480, not {text!r}")
    return int(matched[1]), int(matched[2])


def describe_camera(name: str, camera: Camera) -> dict[str, Any]:
    """What there is to say of a camera, as JSON can hold it."""
    import numpy as np

    from humansim_ros.camera.checks import baseline, check_camera, field_of_view

    view = field_of_view(camera)
    angles = {key: math.degrees(value) for key, value in vars(view).items()}
    reach = camera.lens.valid_radius
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
        "valid_radius": float(reach),
        "valid_angle_deg": float(np.degrees(np.arctan(reach))),
        "warnings": check_camera(camera),
    }


def _lines(calibration: Calibration, facts: dict[str, Any]) -> Iterator[str]:
    count = len(facts["cameras"])
    title = calibration.format.title if calibration.format else "several forms"
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
        f"  {width}x{height} pixels, sees {view['horizontal']} across, {view['vertical']} down, "
        f"{view['diagonal']} from corner to corner"
    )
    yield from _matrix_lines("K", camera["K"])
    lens = f"{camera['model']}, no distortion"
    if any(camera["distortion"]) or camera["model"] == "equidistant":
        lens = f"{camera['model']} {_row(camera['distortion'])}"
        lens += f", good to {camera['valid_angle_deg']:.1f}° off the axis"
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
    """A calibration file, with the options that all commands have."""
    from humansim_ros.camera.calibration import load_calibration

    given = None if size is None else parse_size(size)
    return load_calibration(file, size=given, unit=unit, up=up, image=image)
