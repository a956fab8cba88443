"""More of the ``humansim camera`` commands: ideal cameras, rigs of cameras, and pictures of them."""

from __future__ import annotations

import math
import re
import sys
import warnings
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from humansim_ros.cli import camera as cli_camera
from humansim_ros.cli.camera import Files, Image, Only, Size, Unit, Up
from humansim_ros.cli.output import check_folder, say, warn, written
from humansim_ros.errors import CameraError, HumansimError

if TYPE_CHECKING:
    from humansim_ros.camera import Camera
    from humansim_ros.camera.calibration import Calibration
    from humansim_ros.camera.idealize import Ideal

#: All commands of the group: those of cli_camera, and these.
app = cli_camera.app

#: Bytes of the largest image file that is read.
_MAX_BYTES = 1 << 28
_JPEG = (".jpg", ".jpeg")
#: Metres between cameras and walls: furniture is less deep.
_TO_WALLS = 1.3
_ROOM, _LARGEST_ROOM = (7.0, 6.4, 2.8), 100.0
#: Radius of the circle on which the built-in walk goes round, and of the smallest rig that it fits in.
_WALK, _ROOM_TO_WALK = 1.59, 3.0


class Fitting(Enum):
    focal = "focal"
    all = "all"
    no_black = "no_black"


class Model(Enum):
    plumb_bob = "plumb_bob"
    rational_polynomial = "rational_polynomial"
    equidistant = "equidistant"


Folder = Annotated[Path, typer.Option("--output", "-o", help="The folder; made if it is not there.")]


@app.command()
def idealize(
    file: cli_camera.File,
    output: Folder,
    images: Annotated[
        list[Path] | None, typer.Argument(help="Images of that camera (.png, .jpg), to be corrected.")
    ] = None,
    square: Annotated[bool, typer.Option("--square", help="Square pixels.")] = False,
    keep_center: Annotated[
        bool, typer.Option("--keep-center", help="Leave the principal point where it is.")
    ] = False,
    fit: Annotated[
        Fitting,
        typer.Option(help="Keep the focal lengths; show all of the image; or only what leaves no black."),
    ] = Fitting.focal,
    nearest: Annotated[
        bool, typer.Option("--nearest", help="Do not mix pixels: for images of labels or depth.")
    ] = False,
    size: Size = None,
    image: Image = None,
    unit: Unit = None,
    up: Up = None,
    camera: Only = None,
) -> None:
    """Ideal cameras in place of real ones, and their images: no lens distortion, no skew, the principal point
    in the middle.
    """
    from humansim_ros.camera.idealize import idealize as made_ideal

    calibration = cli_camera.load(file, size, image, unit, up)
    real = cli_camera.chosen(calibration.cameras, camera, file)
    if images and len(real) != 1:
        names = ", ".join(list(real)[:8])
        raise CameraError(f"whose images are these? say --camera, one of {names}", path=file)
    ideals = {name: made_ideal(one, square, not keep_center, fit.value) for name, one in real.items()}
    _make_folder(output)
    _write_ideal(file, output, calibration, {name: ideal.camera for name, ideal in ideals.items()})
    _correct_all(next(iter(ideals.values())), images or [], output, nearest)


@app.command()
def rig(
    output: Folder,
    ring: Annotated[int | None, typer.Option(help="So many cameras on a circle.")] = None,
    grid: Annotated[str | None, typer.Option(help="A wall of cameras: rows and columns, as 2x4.")] = None,
    dome: Annotated[int | None, typer.Option(help="So many cameras over half a sphere.")] = None,
    stereo: Annotated[float | None, typer.Option(help="A stereo pair with this baseline, metres.")] = None,
    radius: Annotated[float, typer.Option(help="Metres from the point that is looked at.")] = 4.0,
    height: Annotated[
        float | None, typer.Option(help="Metres over the floor (1.8), but for a dome.", show_default=False)
    ] = None,
    look_at: Annotated[
        tuple[float, float, float], typer.Option(help="What all look at: x y z in map, metres.")
    ] = (0.0, 0.0, 1.0),
    start_deg: Annotated[
        float, typer.Option(help="Where the first camera stands, degrees from +x to the left.")
    ] = 0.0,
    spacing: Annotated[float, typer.Option(help="Metres between the cameras of a grid.")] = 0.5,
    size: Annotated[str, typer.Option(help="Size of the images.")] = "640x480",
    fov_deg: Annotated[float, typer.Option(help="Horizontal field of view, through the lens.")] = 60.0,
    distortion: Annotated[
        str | None, typer.Option(help="Coefficients of the lens, such as '-0.3 0.1 0 0'.")
    ] = None,
    model: Annotated[
        Model | None, typer.Option(help="Their model; by their number if absent.", show_default=False)
    ] = None,
) -> None:
    """Set up cameras around a place: a scene that `humansim run` takes, and a camera_info file for each."""
    from humansim_ros.camera import rigs

    ways = {"--ring": ring, "--grid": grid, "--dome": dome, "--stereo": stereo}
    given = [way for way, value in ways.items() if value is not None]
    if len(given) != 1:
        raise HumansimError(
            f"say one of {', '.join(ways)}" + (f", not {' and '.join(given)}" if given else "")
        )
    if dome is not None and height is not None:
        raise HumansimError("--height: a dome begins at the height that is looked at (--look-at)")
    if not all(map(math.isfinite, (*look_at, start_deg, fov_deg, spacing, radius, height or 0.0))):
        raise HumansimError("the options are numbers, not nan or infinity")
    lens = (_coefficients(distortion), model.value if model else None)
    optics = rigs.Optics(cli_camera.parse_size(size), math.radians(fov_deg), *lens)
    start, up = math.radians(start_deg), 1.8 if height is None else height
    if ring is not None:
        cameras = rigs.ring(ring, radius, up, look_at, optics, start)
    elif grid is not None:
        rows, columns = _rows_columns(grid)
        cameras = rigs.grid(rows, columns, spacing, radius, up, look_at, optics, start)
    elif dome is not None:
        cameras = rigs.dome(dome, radius, look_at, optics, start)
    else:
        assert stereo is not None
        cameras = rigs.stereo(stereo, radius, up, look_at, optics, start)
    _write_rig(output, cameras, look_at, radius)


@app.command()
def plot(
    files: Files,
    output: Annotated[Path, typer.Option("--output", "-o", help="The picture (.png).")],
    coverage: Annotated[
        bool, typer.Option("--coverage", help="How many cameras see each place instead.")
    ] = False,
    at: Annotated[float, typer.Option(help="Coverage: of a point so many metres over the floor.")] = 1.2,
    stature: Annotated[float, typer.Option(help="Coverage: of a person so tall, metres.")] = 1.8,
    area: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(help="Coverage: x y of two corners, metres; around the rig if absent."),
    ] = None,
    size: Size = None,
    image: Image = None,
    unit: Unit = None,
    up: Up = None,
    camera: Only = None,
) -> None:
    """The cameras of calibrations from above and in space, or what they cover."""
    from humansim_ros.drawing.canvas import write_png
    from humansim_ros.drawing.rigs import coverage_image, rig_image

    if output.suffix.lower() != ".png":
        raise HumansimError("the picture is a .png: give the file that name", path=output)
    check_folder(output)
    cameras = cli_camera.chosen(cli_camera.read_cameras(files, size, image, unit, up), camera, files[0])
    _warn_of_one_place(cameras)
    picture = coverage_image(cameras, at, stature, area) if coverage else rig_image(cameras)
    with written(output):
        write_png(output, picture)
    say(f"wrote {output}")


def _make_folder(folder: Path) -> None:
    with written(folder):
        if folder.exists() and not folder.is_dir():
            raise HumansimError("this is a file: name a folder", path=folder)
        folder.mkdir(parents=True, exist_ok=True)


# -- idealize


def _write_ideal(file: str, output: Path, read: Calibration, cameras: Mapping[str, Camera]) -> None:
    """Ideal cameras in the form that the real ones came in."""
    from humansim_ros.camera.calibration import resolve_url, write_calibration

    source = resolve_url(file) if "://" in file else Path(file)
    several = source.is_dir() or (read.format is not None and read.format.name == "colmap")
    target = output / (source.name if read.format is not None else "cameras.yaml")
    if several and read.format is not None:
        target = output
    _refuse_to_overwrite(source, target)
    for path in write_calibration(target, cameras, read.format.name if read.format else "scene"):
        say(f"wrote {path}")


def _correct_all(ideal: Ideal, images: list[Path], output: Path, nearest: bool) -> None:
    """Corrected images in a folder. What cannot be done is named, and the rest is done all the same."""
    done: set[str] = set()
    failed = False
    for path in images:
        try:
            if path.name in done:
                raise CameraError("another image of this name has been written already", path=path)
            _refuse_to_overwrite(path, output / path.name)
            _correct(ideal, path, output / path.name, nearest)
        except HumansimError as error:
            failed = True
            print(f"error: {error}", file=sys.stderr)
        else:
            done.add(path.name)
            say(f"wrote {output / path.name}")
    if failed:
        raise typer.Exit(2)


def _correct(ideal: Ideal, path: Path, target: Path, nearest: bool) -> None:
    import cv2
    import numpy as np

    from humansim_ros.camera.image_size import image_size
    from humansim_ros.io.files import atomic_path, read_bytes

    if path.suffix.lower() not in (".png", *_JPEG):
        raise CameraError("images are .png or .jpg", path=path)
    size, wanted = image_size(path), ideal.real.size
    if size != wanted:
        message = f"the image is {size[0]}x{size[1]} pixels, the camera {wanted[0]}x{wanted[1]}"
        raise CameraError(message, path=path, key="size")
    data = np.frombuffer(read_bytes(path, CameraError, "image", _MAX_BYTES), np.uint8)
    try:
        image: Any = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.shape[:2] != wanted[::-1]:
        raise CameraError("the image cannot be decoded: it is damaged", path=path)
    corrected = ideal.to_ideal(image, cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 95] if path.suffix.lower() in _JPEG else []
    encoded, content = cv2.imencode(path.suffix, corrected, quality)
    if not encoded:
        raise CameraError("the corrected image cannot be encoded", path=path)
    with written(target), atomic_path(target) as temporary:
        temporary.write_bytes(content.tobytes())


def _refuse_to_overwrite(source: Path, target: Path) -> None:
    if source.resolve() == target.resolve():
        raise HumansimError("would be overwritten: give another folder as --output", path=source)


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
    """scene.yaml, which says all of the cameras, and camera_info files, which say all but where they are."""
    from humansim_ros.camera.calibration import write_calibration
    from humansim_ros.camera.formats.scene import SCENE
    from humansim_ros.io.files import atomic_path

    folder = output / "camera_info"
    _make_folder(folder)
    low = min(camera.center[2] for camera in cameras.values())
    if low <= 0:
        warn(f"the lowest camera is {-low:.2f} m under the floor")
    scene = output / "scene.yaml"
    text = _scene_text(cameras, look_at, radius) + SCENE.write(cameras)[""]
    with written(scene), atomic_path(scene) as temporary:
        temporary.write_text(text, encoding="utf-8")
    say(f"wrote {scene}; try: humansim run {scene}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that these have no place: the scene has them
        for path in write_calibration(folder, cameras, "camera_info"):
            say(f"wrote {path}")


def _scene_text(cameras: Mapping[str, Camera], look_at: tuple[float, float, float], radius: float) -> str:
    """A room that holds all cameras, and somebody for them to look at."""
    x, y, _ = look_at
    centers = [camera.center.tolist() for camera in cameras.values()]
    within = [*centers, (x - _WALK, y - _WALK), (x + _WALK, y + _WALK)]
    walls = [2 * (max(abs(place[axis]) for place in within) + _TO_WALLS) for axis in (0, 1)]
    wanted = (*walls, max(center[2] for center in centers) + 0.3)
    size = [round(max(pair), 1) for pair in zip(_ROOM, wanted, strict=True)]
    room = "null" if max(size) > _LARGEST_ROOM else f"{{size: {size}}}"
    if radius >= _ROOM_TO_WALK:
        motion = f"{{file: walk, position: [{x:g}, {y - _WALK:g}], loop: continue}}"
    else:
        motion = f"{{file: wave, position: [{x:g}, {y:g}], anchor: center}}"
    return f"rate: 30\nroom: {room}\nhumans:\n  walker: {{motion: {motion}}}\n"


# -- plot


def _warn_of_one_place(cameras: Mapping[str, Camera]) -> None:
    centers = {tuple(camera.center.tolist()) for camera in cameras.values()}
    if len(cameras) > 1 and len(centers) == 1:
        warn("all cameras are at one place: do the files say where they stand?")
