"""``humansim camera place``: find the pose of a calibration in ``map``; write a scene and an image."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from humansim_ros.cli.camera import Reading, room_around
from humansim_ros.cli.output import check_output, print_text, print_warning, to_json
from humansim_ros.errors import CameraError, HumansimError, unknown
from humansim_ros.files.reading import write_file

if TYPE_CHECKING:
    from humansim_ros.cameras.camera import Camera, FoundPlacement
    from humansim_ros.cameras.formats import Calibration
    from humansim_ros.types import Array

#: Stature of the person that cameras should see, and margin at head and feet that is not tested, metres.
_STATURE, _MARGIN = 1.8, 0.05
#: Number of digits of written positions and angles.
_DIGITS = 9
#: By name of a residual: its text in the output, and its unit.
_RESIDUALS = {
    "reprojection_px": ("reprojection of the floor points", "px"),
    "plane_mm": ("distance of the floor points from their plane", "mm"),
    "map_mm": ("distance of the floor points from their places in map", "mm"),
    "roll_deg": ("roll of the cameras", "degrees"),
    "axes_mm": ("distance of the optical axes from their common point", "mm"),
}
#: Largest roll of cameras that stand upright, degrees.
_UPRIGHT = 5.0
#: If distances in map and in the file differ by more than this fraction, the unit is probably wrong.
_OTHER_UNIT = 0.05


@dataclass(frozen=True)
class Method:
    """Options of ``place`` that say how a rig is placed. Each attribute has the name of its option."""

    tilt_deg: float | None = None
    roll_deg: float = 0.0
    camera: str | None = None
    floor_points: Path | None = None
    floor_point: list[str] | None = None
    board: Literal["floor", "z_up", "z_down", "standing"] | None = None
    board_pose: str | None = None
    height: float | None = None

    @property
    def name(self) -> str:
        """Name of the method. Raises HumansimError if the options belong to several methods."""
        methods = {
            "--tilt-deg": self.tilt_deg is not None,
            "--floor-points": self.floor_points is not None or bool(self.floor_point),
            "--board": self.board is not None,
        }
        given = [option for option, is_given in methods.items() if is_given]
        if len(given) > 1:
            raise HumansimError(f"give one of {', '.join(methods)}, not {' and '.join(given)}")
        return given[0].removeprefix("--").removesuffix("-deg") if given else "level"

    def find(self, calibration: Calibration, file: str) -> FoundPlacement:
        """Find the placement of the cameras of a calibration."""
        from humansim_ros.cameras.camera import placement

        cameras = _posed(calibration, file)
        name = self.camera if self.camera is not None else next(iter(cameras))
        if name not in cameras:
            raise CameraError(unknown("camera", name, cameras), path=file)
        if self.tilt_deg is not None:
            if self.height is None:
                raise HumansimError(
                    "--tilt-deg needs --height as well: the height of the camera above the floor"
                )
            angles = math.radians(self.tilt_deg), math.radians(self.roll_deg)
            return placement.place_by_tilt(cameras, name, self.height, *angles)
        if self.floor_points is not None or self.floor_point:
            points = _floor_points(calibration, self.floor_points, self.floor_point or ())
            return placement.place_by_floor(cameras, points)
        if self.board is not None:
            pose = _board_pose(calibration, cameras[name], self.board_pose)
            return placement.place_by_board(cameras, pose, self.board, self.height or 0.0)
        return placement.place_by_level(cameras, self.height)


def place(
    file: str,
    output: Path | None = None,
    picture: Path | None = None,
    *,
    how: Method,
    fit_unit: bool = False,
    yaw_deg: float = 0.0,
    at: tuple[float, float] = (0.0, 0.0),
    reading: Reading,
    as_json: bool = False,
) -> None:
    """Find the pose of a calibration in the room: by a tilt, floor points, a board, or level cameras."""
    from humansim_ros.cameras.camera import placement

    if not all(map(math.isfinite, (how.tilt_deg or 0, how.roll_deg, how.height or 0, yaw_deg, *at))):
        raise HumansimError("the options must be finite numbers")
    method = how.name
    if output is not None:
        _check_scene(output, file)
        picture = picture or output.with_suffix(".png")
    check_output(picture, ".png")
    calibration = reading.load(file)
    found = how.find(calibration, file)
    if fit_unit:
        if found.scale is None:
            raise HumansimError("--fit-unit needs two floor points or more with their places in map")
        reading = replace(reading, unit=calibration.unit * found.scale)
        calibration = reading.load(file)
        found = how.find(calibration, file)
    found = placement.turned(found, math.radians(yaw_deg), at)
    placed = {name: found.placement.camera(one) for name, one in _posed(calibration, file).items()}
    facts = _facts(file, method, found, placed, calibration.unit)
    section = _rig_section(file, output, calibration, found, reading)
    if output is not None:
        x, y = facts["person_at"]
        person = f"{{motion: {{file: wave, position: [{x:g}, {y:g}], anchor: center}}}}"
        room = room_around(placed, (x, y))
        write_file(output, f"rate: 30\nroom: {room}\nhumans:\n  person: {person}\n{section}")
    if picture is not None:
        from humansim_ros.render.pictures import write_png
        from humansim_ros.scene.pictures import rig_image

        write_png(picture, rig_image(placed, found.points))
    written = [str(path) for path in (output, picture) if path is not None]
    _warn(placed, facts)
    if as_json:
        print_text(to_json({**facts, "wrote": written}))
        return
    print_text("\n".join(_lines(facts)))
    print_text(section if output is None else f"wrote {output}; try: humansim run {output}")
    if picture is not None:
        print_text(f"wrote {picture}")


def _check_scene(output: Path, file: str) -> None:
    if output.suffix.lower() not in (".yaml", ".yml"):
        raise HumansimError("a scene is a .yaml file: give it this suffix", path=output)
    check_output(output)
    if "://" not in file and output.resolve() == Path(file).resolve():
        raise HumansimError("would be overwritten: give another file with --output", path=output)


def _posed(calibration: Calibration, file: str) -> dict[str, Camera]:
    """Cameras that have extrinsics. If the calibration has only one camera, it needs no extrinsics."""
    posed = {name: one for name, one in calibration.cameras.items() if name in calibration.posed}
    if posed or len(calibration.cameras) == 1:
        return posed or calibration.cameras
    message = "has no extrinsics: the poses of its cameras to each other are unknown, so it cannot be placed"
    raise CameraError(message, path=file)


def _in_metres(calibration: Calibration) -> Array:
    """Matrix (3, 3) from the unit and axes of the file to metres and z up."""
    from humansim_ros.cameras.formats import Z_UP_FROM_FILE

    return calibration.unit * Z_UP_FROM_FILE[calibration.up]


def _floor_points(calibration: Calibration, path: Path | None, texts: Sequence[str]) -> list[Any]:
    from humansim_ros.cameras.camera import parse_floor_point, read_floor_points

    in_metres = _in_metres(calibration)
    points = [] if path is None else read_floor_points(path, in_metres)
    return points + [parse_floor_point(text, in_metres) for text in texts]


def _board_pose(calibration: Calibration, camera: Camera, text: str | None) -> Array:
    """Pose (4, 4) of the calibration board in the world of the calibration file, metres."""
    import numpy as np

    from humansim_ros.cameras.formats import Z_UP_FROM_FILE
    from humansim_ros.geometry import rotation_vector_to_matrix, transform

    if text is None:
        return transform(Z_UP_FROM_FILE[calibration.up], np.zeros(3))
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != 6 or not np.isfinite(values).all():
        message = "needs six numbers, a rotation vector (radians) and a translation (unit of the file)"
        raise HumansimError(f"--board-pose: {message}, not {text!r}")
    in_camera = transform(rotation_vector_to_matrix(values[:3]), values[3:] * calibration.unit)
    return np.asarray(camera.world_from_optical @ in_camera)


def _rounded(value: float) -> float:
    return round(value, _DIGITS) + 0.0


def _facts(
    file: str, method: str, found: FoundPlacement, placed: Mapping[str, Camera], unit: float
) -> dict[str, Any]:
    """Collect facts about a placement for ``--json``.

    Args:
        file: Calibration file.
        method: Name of the method.
        found: The placement.
        placed: Cameras in ``map``.
        unit: Metres per unit of the file.
    """
    import numpy as np

    from humansim_ros.cameras.camera import look_target

    x, y, _ = (round(float(value), 3) + 0.0 for value in look_target(placed))
    heights = np.linspace(_MARGIN, _STATURE - _MARGIN, 9)
    person = np.column_stack([np.full(9, x), np.full(9, y), heights])
    cameras = []
    for name, camera in placed.items():
        pixels = camera.project(person)[0]
        inside = ((pixels >= -0.5) & (pixels < np.array(camera.size) - 0.5)).all(axis=1)
        down = math.degrees(math.asin(max(-1.0, min(1.0, -float(camera.R[2, 2])))))
        cameras.append(
            {
                "name": name,
                "center": (np.round(camera.center, _DIGITS) + 0.0).tolist(),
                "tilt_deg": down,
                "sees": "all" if inside.all() else "part" if inside.any() else "nothing",
            }
        )
    return {
        "file": file,
        "method": method,
        "residuals": {key: _rounded(value) for key, value in found.residuals.items()},
        "scale": None if found.scale is None else _rounded(found.scale),
        "unit": unit,
        "position": (np.round(found.placement.position, _DIGITS) + 0.0).tolist(),
        "rotation_deg": (np.round(found.placement.rotation_deg, _DIGITS) + 0.0).tolist(),
        "person_at": [x, y],
        "cameras": cameras,
    }


def _lines(facts: dict[str, Any]) -> list[str]:
    lines = [f"{facts['file']}: placed by {facts['method']}"]
    for key, value in facts["residuals"].items():
        text, unit = _RESIDUALS[key]
        lines.append(f"  {text}: {value:.3g} {unit}")
    longest = max(len(camera["name"]) for camera in facts["cameras"])
    for camera in facts["cameras"]:
        x, y, z = camera["center"]
        tilt = float(camera["tilt_deg"])
        down = f"looks {abs(tilt):.1f} degrees {'down' if tilt >= 0 else 'up'}"
        sees = f"sees {camera['sees']} of a person of {_STATURE:g} m"
        lines.append(f"  {camera['name']:{longest}}  at {x:.2f} {y:.2f}, {z:.2f} m high, {down}, {sees}")
    x, y = facts["person_at"]
    return [*lines, f"  the person stands at {x:g} {y:g}"]


def _warn(placed: Mapping[str, Camera], facts: dict[str, Any]) -> None:
    low = min(float(camera.center[2]) for camera in placed.values())
    if low < 0:
        print_warning(f"the lowest camera is {-low:.2f} m below the floor")
    blind = [camera["name"] for camera in facts["cameras"] if camera["sees"] == "nothing"]
    if blind:
        print_warning(f"the person is not in the view of {', '.join(blind[:4])}")
    if facts["scale"] is not None and abs(facts["scale"] - 1) > _OTHER_UNIT:
        times = f"distances in map are {facts['scale']:.4g} times the distances of the file"
        print_warning(f"{times}: is the unit of the file correct? --fit-unit takes it from map")
    if facts["method"] == "level" and facts["residuals"]["roll_deg"] > _UPRIGHT:
        roll = f"the cameras are rolled by {facts['residuals']['roll_deg']:.0f} degrees"
        print_warning(f"{roll}, so they do not stand upright: place them by floor points")


def _rig_section(
    file: str,
    output: Path | None,
    calibration: Calibration,
    found: FoundPlacement,
    reading: Reading,
) -> str:
    """Return the text of the section ``rig`` of a scene.

    Args:
        file: Calibration file.
        output: Scene file. The path of the calibration is relative to the folder of this file.
        calibration: Content of the calibration file.
        found: Placement of the cameras.
        reading: Options for reading the file, which the section repeats.
    """
    name = file
    if "://" not in file and output is not None and not Path(file).is_absolute():
        name = os.path.relpath(Path(file).resolve(), output.resolve().parent)
    lines = ["rig:", f"  file: {json.dumps(name)}"]
    finds_unit = calibration.format is not None and calibration.format.find_unit is not None
    if reading.unit is not None or finds_unit:
        lines.append(f"  unit: {calibration.unit:g}")
    if reading.up is not None:
        lines.append(f"  up_axis: {json.dumps(reading.up)}")
    if reading.size or reading.image:
        width, height = next(iter(calibration.cameras.values())).size
        lines.append(f"  size: [{width}, {height}]")
    for key, values in (
        ("rotation_deg", found.placement.rotation_deg),
        ("position", found.placement.position),
    ):
        lines.append(f"  {key}: [{', '.join(repr(round(float(v), _DIGITS) + 0.0) for v in values)}]")
    return "\n".join(lines) + "\n"
