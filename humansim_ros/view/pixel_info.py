"""Numbers of a pixel of a scene, as its topics say them."""

from __future__ import annotations

import numpy as np

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
    colour = color_image(view.rgb, scene.scene_cameras[camera].encoding)[y, x]
    values = {"camera": camera, "pixel": f"({x}, {y})", "rgb": ", ".join(str(int(c)) for c in colour)}
    depth, world = float(view.depth[y, x]), None
    if np.isfinite(depth):
        world = seen_by.unproject([[x, y]], [depth])[0]
        values |= {"depth": f"{depth:.4f} m", "world": point_text(world)}
        values["optical frame"] = point_text(seen_by.R @ world + seen_by.t)
        values["normal"] = ", ".join(f"{value:.3f}" for value in view.normal[y, x])
    else:
        values["depth"] = "nothing is there"
    instance = int(view.instance[y, x])
    owner = next((name for name, label in scene.labels.items() if label == instance), None)
    if owner is not None:
        values["instance"] = f"{instance} ({owner})"
    if owner in scene.actors:
        part = int(view.part[y, x])
        names = scene.actors[owner].human.skeleton.names
        values["part"] = f"{part} ({names[part - 1]})" if 0 < part <= len(names) else str(part)
        values["face"] = str(int(view.face[y, x]))
    values |= _near_joint(scene, frame, camera, x, y)
    return PixelInfo(values, world)


def _near_joint(scene: Scene, frame: Frame, camera: str, x: int, y: int) -> dict[str, str]:
    """The joint whose projection is nearest to a pixel, if it is near."""
    reach, found = _NEAR * frame.cameras[camera].size[0], {}
    for name, joints in frame.truth[camera].joints.items():
        distances = np.linalg.norm(joints.pixels - (x, y), axis=1)
        if not np.isfinite(distances).any() or np.nanmin(distances) > reach:
            continue
        number = int(np.nanargmin(distances))
        reach = float(distances[number])
        joint = scene.actors[name].human.skeleton.joint_names[number]
        pixel = joints.pixels[number]
        found = {
            "joint": f"{joint} of {name}",
            "joint, pixel": f"({pixel[0]:.2f}, {pixel[1]:.2f})",
            "joint, world": point_text(frame.humans[name].positions[number]),
            "joint, visibility": _STATES.get(int(joints.visible[number]), "unknown"),
        }
    return found


def point_text(point: Array) -> str:
    """Coordinates in metres as text."""
    return "({:.4f}, {:.4f}, {:.4f}) m".format(*point)
