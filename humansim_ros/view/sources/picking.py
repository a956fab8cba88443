"""Values to show after a click: of a pixel of an image, as topics have them, or of a point of a person."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import SceneError
from humansim_ros.people.humans import Human
from humansim_ros.scene.core import Frame, Scene
from humansim_ros.scene.pictures import color_image
from humansim_ros.scene.truth import OCCLUDED, OUTSIDE, VISIBLE
from humansim_ros.types import Array
from humansim_ros.view.sources.source import PixelInfo, ViewFrame, ViewSource

#: Channels that are needed for the values of a pixel.
PIXEL_CHANNELS = ("rgb", "depth", "instance", "part", "normal", "face")
#: The nearest joint is shown if its distance from the pixel is below this share of the image width.
_NEAR = 0.02
_STATES = {VISIBLE: "visible", OCCLUDED: "occluded", OUTSIDE: "outside the image"}


def pixel_info(scene: Scene, frame: Frame, camera: str, x: int, y: int) -> PixelInfo:
    """Values of a pixel of a scene, from the exact truth.

    Args:
        scene: The scene.
        frame: Frame of the scene, with the channels :data:`PIXEL_CHANNELS` of the camera.
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
        pixels: (J, 2) positions in the image; NaN for joints that have none.
        visible: (J,) states of the joints, such as visible or occluded.
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
    """Texts about the surface at a pixel, and its point (3,) in ``map``; None if the depth is unknown.

    Args:
        camera: Name of the camera.
        pixel: Column and row.
        seen_by: The camera.
        found: Known values of the pixel by channel: ``rgb``, ``depth`` in metres, ``normal``.
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
    """Texts about the joint that is nearest to a pixel in the image; empty if no joint is near.

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


# --- points of people

#: A pixel shows a point if the surface at the pixel is at most this far from the point, metres.
_SAME = 0.03


@dataclass(frozen=True)
class Hit:
    """Point on the skin that a ray hits.

    Attributes:
        point: (3,) in ``map``, metres.
        triangle: Number of the triangle.
        vertex: Number of the vertex that is nearest to the point.
    """

    point: Array
    triangle: int
    vertex: int


def hit_person(human: Human, joints: Array, origin: Array, direction: Array) -> Hit | None:
    """First point of a posed human that a ray hits [Moller 1997]; None if the ray misses the human.

    Args:
        human: The human in the rest pose.
        joints: (J, 4, 4) poses in ``map``, bones first.
        origin: Start (3,) of the ray in ``map``.
        direction: Direction (3,) of the ray.
    """
    vertices = human.pose(joints[: len(human.skeleton)]).astype(float)
    triangles = human.mesh.triangles
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    across = np.cross(np.broadcast_to(direction, b.shape), c - a)
    determinant = np.einsum("ij,ij->i", b - a, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = origin - a
        u = np.einsum("ij,ij->i", offset, across) / determinant
        other = np.cross(offset, b - a)
        v = other @ direction / determinant
        distance = np.einsum("ij,ij->i", c - a, other) / determinant
    inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    if not inside.any():
        return None
    triangle = int(np.argmin(np.where(inside, distance, np.inf)))
    point = origin + distance[triangle] * direction
    corners = triangles[triangle]
    nearest = int(corners[np.argmin(np.linalg.norm(vertices[corners] - point, axis=1))])
    return Hit(point, triangle, nearest)


def person_info(source: ViewSource, frame: ViewFrame, name: str, hit: Hit) -> PixelInfo:
    """Values of a point of a person: position, body part, joint, and its pixel in each camera.

    Args:
        source: The source.
        frame: The frame that the source returned last.
        name: Name of the person.
        hit: The point.
    """
    human = source.people[name]
    skeleton = human.skeleton
    part = int(human.triangle_parts[hit.triangle])
    positions = frame.joints[name][:, :3, 3]
    joint = int(np.argmin(np.linalg.norm(positions - hit.point, axis=1)))
    values = {
        "person": name,
        "world": point_text(hit.point),
        "part": f"{part} ({skeleton.names[part - 1]})",
        "face": str(int(human.mesh.triangle_faces[hit.triangle])),
        "vertex": str(hit.vertex),
        "joint": skeleton.joint_names[joint],
        "joint, world": point_text(positions[joint]),
    }
    for camera_name, camera in frame.cameras.items():
        pixels, depths = camera.project(hit.point[None])
        x, y = (float(value) for value in pixels[0])
        if not (
            np.isfinite(x)
            and np.isfinite(y)
            and -0.5 <= x < camera.size[0] - 0.5
            and -0.5 <= y < camera.size[1] - 0.5
        ):
            values[camera_name] = "outside the image"
            continue
        surface = source.describe(camera_name, round(x), round(y)).world
        seen = surface is not None and float(np.linalg.norm(surface - hit.point)) < _SAME
        text = "visible" if seen else "occluded"
        values[camera_name] = f"pixel ({x:.2f}, {y:.2f}), depth {float(depths[0]):.4f} m, {text}"
    return PixelInfo(values, hit.point)
