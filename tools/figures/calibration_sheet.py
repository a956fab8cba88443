"""Render a scene with each calibration of a folder, one tile per camera (docs/images/calibrations.jpg).

    python tools/figures/calibration_sheet.py FOLDER -o sheet.jpg

Three humans are placed at the intersection of the optical axes of a rig, in a room that contains the rig.
Cameras without a pose are placed in the room of the demo scene.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros.cameras import Camera  # noqa: E402
from humansim_ros.cameras.formats.calibration import load_calibration  # noqa: E402
from humansim_ros.errors import HumansimError, HumansimWarning  # noqa: E402
from humansim_ros.render import Body, GLRenderer  # noqa: E402
from humansim_ros.scene import Scene  # noqa: E402
from humansim_ros.scene.config.config import SceneConfig  # noqa: E402
from humansim_ros.scene.features.room.feature import furnished_room  # noqa: E402
from humansim_ros.types import Array, Image  # noqa: E402

_TILE = (330, 252)
_COLUMNS = 5
#: Number of tiles of these files, in this order. Other files come first, with up to five cameras.
_SHOWN = {"campus_voxelpose": 3, "shelf_voxelpose": 5, "human36m_camera-parameters": 4, "templeSR_par": 1}
_MAX = 5
_ROOM = (7.0, 6.4, 2.8)
#: Motion of each human, yaw in degrees, and offset (x, y) from the target of the cameras, metres.
_PEOPLE = {
    "adult_man": ("wave", -50, (-0.2, 0.55)),
    "adult_woman": ("walk", 0, (-0.35, -0.55)),
    "child": ("run", 60, (0.5, 0.1)),
}
_SECONDS = 1.1
#: Position and target of a camera without a pose, metres.
_PLACE, _TARGET = (2.75, -2.1, 1.75), (0.0, 0.0, 0.85)
#: Metres per unit, up axis and floor height in units of the temple data set; the temple is 0.16 long in y.
_SMALL = ("templeSR_par", 11.0, "y", -0.038)


def people() -> list[Body]:
    """Three humans around the origin."""
    humans = {
        body: {"body": body, "motion": {"file": motion, "yaw_deg": yaw}}
        for body, (motion, yaw, _) in _PEOPLE.items()
    }
    camera = {"position": _PLACE, "look_at": _TARGET}
    config = SceneConfig.model_validate({"room": None, "humans": humans, "cameras": {"any": camera}})
    bodies = []
    for name, actor in Scene.from_config(config).actors.items():
        vertices = actor.at(_SECONDS).vertices
        away = np.array([*_PEOPLE[name][2], 0]) - [*vertices[:, :2].mean(axis=0), 0]
        bodies.append(actor.body((vertices + away).astype(np.float32)))
    return bodies


def meeting_point(cameras: list[Camera]) -> Array:
    """Point (3,) with the smallest sum of squared distances from all optical axes."""
    across = [np.eye(3) - np.outer(camera.R[2], camera.R[2]) for camera in cameras]
    toward = sum(a @ camera.center for a, camera in zip(across, cameras, strict=True))
    return np.linalg.solve(sum(across), toward)


def tiles(path: Path, group: list[Body]) -> Iterator[Image]:
    """Render the images of the cameras of a file."""
    unit, up, floor, note = None, None, 0.0, ""
    if path.stem == _SMALL[0]:
        _, unit, up, base = _SMALL
        floor, note = base * unit, f", {unit:g} m a unit, {up} up"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", HumansimWarning)
        found = load_calibration(path, unit=unit, up=up)
    for warning in caught:
        print(warning.message)
        if "this K is of an image of about" in str(warning.message):
            note = ", K of another size"
    cameras = list(found.cameras.values())
    if len(cameras) == 1 and not cameras[0].center.any():
        there = Camera.look_at(_PLACE, _TARGET)
        cameras = [replace(cameras[0], R=there.R, t=there.t)]
        middle, size = np.zeros(3), _ROOM
    else:
        middle = meeting_point(cameras)
        middle[2] = floor
        reach = np.abs([camera.center - middle for camera in cameras]).max(axis=0)
        across, along, height = np.maximum(_ROOM, reach * (2, 2, 1) + (1.6, 1.6, 0.4)).tolist()
        size = across, along, height
    meshes = [replace(mesh, vertices=mesh.vertices + middle) for mesh in furnished_room(size)]
    bodies = [replace(body, vertices=(body.vertices + middle).astype(np.float32)) for body in group]
    renderer = GLRenderer(meshes)
    for name, camera in list(zip(found.cameras, cameras, strict=True))[: _SHOWN.get(path.stem, _MAX)]:
        view = renderer.render(bodies, camera, ("rgb",), moving_camera=True)
        title = path.name + (f" {name}" if len(cameras) > 1 else "")
        yield tile(view.rgb, title, f"{camera.model}, {camera.size[0]}x{camera.size[1]}{note}")
    renderer.close()


def tile(picture: Image, title: str, subtitle: str) -> Image:
    width, height = _TILE
    scale = min(width / picture.shape[1], height / picture.shape[0])
    size = round(picture.shape[1] * scale), round(picture.shape[0] * scale)
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    out = np.full((height + 40, width + 4, 3), 28, np.uint8)
    left = (width + 4 - size[0]) // 2
    out[38 : 38 + size[1], left : left + size[0]] = small
    for row, (text, color) in enumerate(((title, (240, 240, 240)), (subtitle, (176, 190, 204)))):
        place = (5, 15 + 16 * row)
        cv2.putText(out, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, color, 1, cv2.LINE_AA)
    return out


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--output", "-o", type=Path, default=Path("sheet.jpg"))
    options = parser.parse_args()
    group, shown = people(), []
    order = list(_SHOWN)
    files = sorted(
        options.folder.iterdir(), key=lambda f: (order.index(f.stem) if f.stem in order else -1, f)
    )
    for path in files:
        try:
            shown.extend(tiles(path, group))
        except HumansimError as error:
            print(f"skipped: {error}")
    if not shown:
        print(f"no calibration in {options.folder}")
        return 1
    shown += [np.full_like(shown[0], 28)] * (-len(shown) % _COLUMNS)
    rows = [np.concatenate(shown[i : i + _COLUMNS], 1) for i in range(0, len(shown), _COLUMNS)]
    cv2.imwrite(str(options.output), np.concatenate(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 74])
    return 0


if __name__ == "__main__":
    sys.exit(main())
