"""Numbers of a pixel of a scene, as its topics say them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.drawing.views import color_image
from humansim_ros.errors import SceneError
from humansim_ros.scene.scene import Scene
from humansim_ros.scene.simulation import Frame
from humansim_ros.truth.joints import OCCLUDED, OUTSIDE, VISIBLE
from humansim_ros.types import Array
from humansim_ros.view.source import PixelInfo

#: Channels that the numbers come from.
CHANNELS = ("rgb", "depth", "instance", "part", "normal", "face")
#: Joints that are nearer to the pixel than this share of the image's width are told.
_NEAR = 0.02
_STATES = {VISIBLE: "visible", OCCLUDED: "occluded", OUTSIDE: "outside the image"}


def pixel_info(scene: Scene, frame: Frame, camera: str, x: int, y: int) -> PixelInfo:
    """Numbers of a pixel.

    Args:
        scene: The scene.
        frame: Its frame, with :data:`CHANNELS` of the camera.
        camera: Name of the camera.
        x: Column, from 0 at the left.
        y: Row, from 0 at the top.

    Raises:
        SceneError: The pixel is not in the image.
    """
    view, seen_by = frame.views[camera], frame.cameras[camera]
    width, height = seen_by.size
    if not (0 <= x < width and 0 <= y < height):
        raise SceneError(f"{camera} has no pixel ({x}, {y}): its images have {width}x{height} pixels")
    pixel = {name: getattr(view, name)[y, x] for name in ("depth", "normal")}
    pixel["rgb"] = color_image(view.rgb, scene.scene_cameras[camera].encoding)[y, x]
    values, world = surface_values(camera, (x, y), seen_by, pixel)
    instance = int(view.instance[y, x])
    owner = next((name for name, label in scene.labels.items() if label == instance), None)
    if owner is not None:
        values["instance"] = f"{instance} ({owner})"
    if owner in scene.actors:
        part = int(view.part[y, x])
        names = scene.actors[owner].human.skeleton.names
        values["part"] = f"{part} ({names[part - 1]})" if 0 < part <= len(names) else str(part)
        values["face"] = str(int(view.face[y, x]))
    seen = (
        JointsInImage(
            name,
            scene.actors[name].human.skeleton.joint_names,
            joints.pixels,
            joints.visible,
            frame.humans[name].positions,
        )
        for name, joints in frame.truth[camera].joints.items()
    )
    return PixelInfo(values | near_joint_values(seen, (x, y), width), world)


@dataclass(frozen=True)
class JointsInImage:
    """Joints of a person in an image.

    Attributes:
        person: Name of the person.
        names: Names of the joints.
        pixels: (J, 2); NaN for joints without one.
        visible: (J,) their states.
        positions: (J, 3) in ``map``; NaN where unknown.
    """

    person: str
    names: Sequence[str]
    pixels: Array
    visible: NDArray[np.uint8]
    positions: Array


def surface_values(
    camera: str, pixel: tuple[int, int], seen_by: Camera, found: Mapping[str, Any]
) -> tuple[dict[str, str], Array | None]:
    """Texts about the surface in a pixel, and its point (3,) in ``map`` if its depth is known.

    Args:
        camera: Name of the camera.
        pixel: Column and row.
        seen_by: The camera.
        found: Values of the pixel by channel: ``rgb``, ``depth`` in metres, ``normal``; those that are known.
    """
    x, y = pixel
    values, world = {"camera": camera, "pixel": f"({x}, {y})"}, None
    if "rgb" in found:
        values["rgb"] = ", ".join(str(int(value)) for value in found["rgb"])
    if "depth" not in found:
        return values, None
    depth = float(found["depth"])
    if np.isfinite(depth):
        world = seen_by.unproject([[x, y]], [depth])[0]
        values |= {"depth": f"{depth:.4f} m", "world": point_text(world)}
        values["optical frame"] = point_text(seen_by.R @ world + seen_by.t)
        if "normal" in found:
            values["normal"] = ", ".join(f"{value:.3f}" for value in found["normal"])
    else:
        values["depth"] = "nothing is there"
    return values, world


def near_joint_values(people: Iterable[JointsInImage], pixel: tuple[int, int], width: int) -> dict[str, str]:
    """Texts about the joint whose projection is nearest to a pixel; none if no joint is near.

    Args:
        people: Joints in the image.
        pixel: Column and row.
        width: Width of the image.
    """
    reach, found = _NEAR * width, {}
    for joints in people:
        distances = np.linalg.norm(joints.pixels - pixel, axis=1)
        if not np.isfinite(distances).any() or np.nanmin(distances) > reach:
            continue
        number = int(np.nanargmin(distances))
        reach = float(distances[number])
        across, down = joints.pixels[number]
        found = {
            "joint": f"{joints.names[number]} of {joints.person}",
            "joint, pixel": f"({across:.2f}, {down:.2f})",
            "joint, world": point_text(joints.positions[number]),
            "joint, visibility": _STATES.get(int(joints.visible[number]), "unknown"),
        }
    return found


def point_text(point: Array) -> str:
    """Coordinates in metres as text."""
    return "({:.4f}, {:.4f}, {:.4f}) m".format(*point)
