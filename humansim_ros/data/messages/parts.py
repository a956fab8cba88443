"""Parts of messages: points, vectors, rotations, poses, velocities and colours."""

from __future__ import annotations

from typing import Any

from humansim_ros.data.messages.types import ColorRGBA, Point, Pose, Quaternion, Twist, Vector3
from humansim_ros.types import Array, Color, FloatArray


def point(position: Array) -> Point:
    """Build a Point from a position (3,)."""
    x, y, z = position.tolist()
    return Point(x=x, y=y, z=z)


def points(positions: FloatArray) -> list[Point]:
    """Build a Point for each row of an array (N, 3)."""
    return [Point(x=x, y=y, z=z) for x, y, z in positions.tolist()]


def vector(values: Array) -> Vector3:
    """Build a Vector3 from an array (3,)."""
    x, y, z = values.tolist()
    return Vector3(x=x, y=y, z=z)


def quaternion(rotation: Array) -> Quaternion:
    """Build a Quaternion from a rotation (4,) xyzw."""
    x, y, z, w = rotation.tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def pose(position: Array, rotation: Array) -> Pose:
    """Build a Pose from a position (3,) and a rotation (4,) xyzw."""
    return Pose(position=point(position), orientation=quaternion(rotation))


def twist(linear: Array, angular: Array) -> Twist:
    """Build a Twist from two velocities (3,)."""
    return Twist(linear=vector(linear), angular=vector(angular))


def color(rgb: Color) -> ColorRGBA:
    """Build an opaque colour from components of 0 to 255."""
    red, green, blue = (component / 255 for component in rgb)
    return ColorRGBA(r=red, g=green, b=blue, a=1.0)


def xyz(part: Any) -> tuple[float, float, float]:
    """Numbers of a Point or Vector3."""
    return part.x, part.y, part.z


def xyzw(part: Any) -> tuple[float, float, float, float]:
    """Numbers of a Quaternion."""
    return part.x, part.y, part.z, part.w
