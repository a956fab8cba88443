"""Messages of moving objects, and velocities of objects and cameras."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from humansim_ros.errors import RosError, within_bounds
from humansim_ros.messages.headers import WORLD_FRAME, header
from humansim_ros.messages.types import ColorRGBA, Marker, Point, Pose, Quaternion, TwistStamped, Vector3
from humansim_ros.motion.kinematics import Velocity
from humansim_ros.scene.objects import FURNITURE, ObjectPose, SceneObject

_MARKER_TYPES = {"box": Marker.CUBE, "sphere": Marker.SPHERE, "cylinder": Marker.CYLINDER}


def object_message(scene_object: SceneObject, pose: ObjectPose, stamp: int) -> Marker:
    """Build ``objects/<name>/marker``: a moving object with its pose and size, as RViz shows it."""
    furniture = scene_object.shape in FURNITURE
    other = Marker.TRIANGLE_LIST if furniture else Marker.MESH_RESOURCE
    shape = _MARKER_TYPES.get(scene_object.shape, other)
    marker = Marker(header=header(stamp, WORLD_FRAME), ns=f"objects/{scene_object.name}", type=shape)
    marker.action = Marker.ADD
    x, y, z = pose.position.tolist()
    qx, qy, qz, qw = pose.rotation.tolist()
    marker.pose = Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
    marker.scale = Vector3(**dict(zip("xyz", pose.size.tolist(), strict=True)))
    red, green, blue = (c / 255 for c in scene_object.color)
    marker.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
    if shape == Marker.MESH_RESOURCE:
        marker.mesh_resource = Path(scene_object.shape).as_uri()
    elif furniture:
        marker.points = _triangle_points(scene_object.shape)
    return marker


@lru_cache
def _triangle_points(name: str) -> list[Point]:
    """Corners of the triangles of a built-in piece of furniture, three for each."""
    mesh = FURNITURE[name].mesh()
    return [Point(x=x, y=y, z=z) for x, y, z in mesh.vertices[mesh.triangles].reshape(-1, 3).tolist()]


def read_object(message: Marker) -> ObjectPose:
    """Read the object pose of a ``marker`` message. Raises RosError if it is not finite or has no size."""
    p, q, s = message.pose.position, message.pose.orientation, message.scale
    pose = ObjectPose(np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]), np.array([s.x, s.y, s.z]))
    if not within_bounds([*pose.position, *pose.rotation, *pose.size]):
        raise RosError("an object's pose or size is not finite, or above 1000 km")
    if not abs(np.linalg.norm(pose.rotation) - 1) < 1e-3 or not (pose.size > 0).all():
        raise RosError("an object's quaternion has not length 1, or its size is 0")
    return pose


def twist_message(velocity: Velocity | None, stamp: int) -> TwistStamped:
    """Build ``objects/<name>/twist`` or ``<camera>/twist``: velocity in the axes of ``map``; NaN if it is
    unknown.
    """
    linear, angular = (np.full(3, np.nan),) * 2 if velocity is None else (velocity.linear, velocity.angular)
    message = TwistStamped(header=header(stamp, WORLD_FRAME))
    for part, value in ((message.twist.linear, linear), (message.twist.angular, angular)):
        part.x, part.y, part.z = value.tolist()
    return message


def read_twist(message: TwistStamped) -> Velocity | None:
    """Read the velocity of a ``twist`` message; None if it is not finite, or beyond
    :mod:`humansim_ros.errors`.
    """
    parts = message.twist.linear, message.twist.angular
    linear, angular = (np.array([part.x, part.y, part.z]) for part in parts)
    return Velocity(linear, angular) if within_bounds([*linear, *angular]) else None
