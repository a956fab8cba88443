"""Points of people that are clicked in the page."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from humansim_ros.humans import Human
from humansim_ros.types import Array
from humansim_ros.view.pixel_info import point_text
from humansim_ros.view.source import PixelInfo, ViewFrame, ViewSource

#: Distance between a point and the surface in a pixel up to which the pixel shows the point, metres.
_SAME = 0.03


@dataclass(frozen=True)
class Hit:
    """Point on the skin.

    Attributes:
        point: (3,) in ``map``, metres.
        triangle: Number of the triangle.
        vertex: Number of its nearest vertex.
    """

    point: Array
    triangle: int
    vertex: int


def hit_person(human: Human, joints: Array, origin: Array, direction: Array) -> Hit | None:
    """First point of a posed human on a ray [Moller 1997]; None if it misses.

    Args:
        human: The human at rest.
        joints: (J, 4, 4) poses in ``map``, bones first.
        origin: (3,) in ``map``.
        direction: (3,).
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
    """Numbers of a point of a person: world, part, joint, and its pixel in each camera.

    Args:
        source: The source.
        frame: Its frame that was given last.
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
