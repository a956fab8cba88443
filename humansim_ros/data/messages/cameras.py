"""Messages of a camera's calibration and pose, and messages of moving objects."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import scipy.spatial

from humansim_ros.cameras.camera import Camera, Region
from humansim_ros.cameras.formats import read_calibration, resolve_url, write_calibration
from humansim_ros.data.messages import parts
from humansim_ros.data.messages.headers import WORLD_FRAME, header
from humansim_ros.data.messages.types import (
    CameraInfo,
    Float64MultiArray,
    Marker,
    MultiArrayDimension,
    Point,
    Pose,
    PoseStamped,
    Transform,
    TransformStamped,
    TwistStamped,
)
from humansim_ros.errors import CameraError, RosError, within_bounds
from humansim_ros.files.mesh import Mesh
from humansim_ros.geometry import ObjectPose, Velocity, matrix_to_quaternion, unit_quaternions
from humansim_ros.render.device import WeakCache
from humansim_ros.scene.core import CameraPose, SceneCamera, SceneObject
from humansim_ros.types import Array

_WHOLE_SENSOR = Region()
#: Most distortion coefficients of any lens model, and most characters of its name.
_MAX_DISTORTION, _MAX_NAME = 14, 64


def read_lens(url: str, name: str) -> Camera:
    """Read a calibration file or URL with one camera. ``name``: replaces ``${NAME}``.

    Raises:
        CameraError: The file has several cameras, or none that can be read.
    """
    path = resolve_url(url, name)
    cameras = read_calibration(path)
    if len(cameras) > 1:
        raise CameraError(f"there are {len(cameras)} cameras in this file, a driver has one", path=path)
    return next(iter(cameras.values()))


class PublishedCalibration:
    """Calibration for ``<camera>/camera_info``, which may be another one than that of the images.

    Attributes:
        name: Name of the camera.
        published: Calibration of the whole sensor in ``<camera>/camera_info``.
        beside_truth: Calibration for ``camera_info`` next to images of ground truth, such as depth. It is the
            true one until it is replaced.
    """

    def __init__(self, camera: SceneCamera) -> None:
        self.name = camera.name
        self._rendered = self.beside_truth = camera.whole
        self.published = camera.published

    def replace(self, camera: Camera, source: str | None = None) -> None:
        """Publish another calibration. If its image size is wrong, CameraError names ``source``."""
        if camera.size != self._rendered.size:
            (w, h), (width, height) = camera.size, self._rendered.size
            message = f"this calibration is for {w}x{h} pixels, the camera has {width}x{height}"
            raise CameraError(message, path=source)
        self.published = self.beside_truth = camera

    def save(self) -> Path:
        """Write the published calibration to the same place as camera drivers:
        ``$ROS_HOME/camera_info/<camera>.yaml``. Returns the path. Raises OSError or HumansimError if that
        fails."""
        home = os.environ.get("ROS_HOME") or str(Path.home() / ".ros")
        path = Path(home) / "camera_info" / f"{self.name}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_calibration(path, {self.name: self.published})
        return path


def camera_info_message(camera: Camera, stamp: int, frame: str, region: Region = _WHOLE_SENSOR) -> CameraInfo:
    """Build ``<camera>/camera_info``.

    Size, K, D, R and P are those of the whole sensor, even if the images show only a region. Drivers publish
    them so. K contains the skew, which OpenCV and image_geometry ignore. P has no skew.

    Args:
        camera: Calibration of the whole sensor.
        stamp: Nanoseconds.
        frame: Optical frame of the camera.
        region: Binning and region of interest of the images.
    """
    message = CameraInfo(header=header(stamp, frame), width=camera.size[0], height=camera.size[1])
    message.distortion_model = camera.model
    message.d = list(camera.distortion)
    message.k = camera.K.ravel()
    message.r = camera.rectification_matrix.ravel()
    message.p = camera.rectified_projection.ravel()
    if not region.whole:
        message.binning_x, message.binning_y = region.binning
    if region.roi is not None:
        message.roi.x_offset, message.roi.y_offset, message.roi.width, message.roi.height = region.roi
    return message


def read_camera_info(message: CameraInfo) -> Camera:
    """Read a camera from a CameraInfo. Its pose is the origin. Raises CameraError if not valid."""
    if len(message.d) > _MAX_DISTORTION or len(message.distortion_model) > _MAX_NAME:
        raise CameraError(f"a lens with more than {_MAX_DISTORTION} coefficients, or of no known model")
    if not within_bounds([*message.k, *message.d, *message.r, *message.p]):
        raise CameraError("a number of a calibration is not finite, or above a million")
    k, r = np.reshape(message.k, (3, 3)), np.reshape(message.r, (3, 3))
    return Camera(
        (message.width, message.height),
        k,
        np.eye(3),
        np.zeros(3),
        tuple(message.d),
        {"": None, "fisheye": "equidistant"}.get(message.distortion_model, message.distortion_model),
        r if r.any() else None,
        np.reshape(message.p, (3, 4)) if np.any(message.p) else None,
    )


def read_region(message: CameraInfo) -> Region:
    """Read binning and region of interest of a CameraInfo."""
    roi = message.roi
    window = (roi.x_offset, roi.y_offset, roi.width, roi.height)
    return Region(
        window if roi.width and roi.height else None, (message.binning_x or 1, message.binning_y or 1)
    )


def pose_message(pose: CameraPose, stamp: int) -> PoseStamped:
    """Build ``<camera>/pose``: pose of the optical frame of a moving camera in ``map``."""
    return PoseStamped(header=header(stamp, WORLD_FRAME), pose=parts.pose(pose.position, pose.rotation))


def read_pose(message: PoseStamped) -> CameraPose:
    """Read a ``<camera>/pose`` message. Raises RosError if the pose is not in ``map``, not finite, or has no
    valid rotation."""
    if message.header.frame_id != WORLD_FRAME:
        raise RosError(f"a camera's pose must be in {WORLD_FRAME}, this is in {message.header.frame_id!r}")
    return CameraPose.at(*rigid_pose(message.pose, "a camera's pose"))


def rigid_pose(pose: Pose, what: str) -> tuple[Array, Array]:
    """Position (3,) and rotation (4,) xyzw of a Pose message. Raises RosError if a number is not finite or
    the rotation is not valid; ``what`` names the pose in the text of the error."""
    position, rotation = np.array(parts.xyz(pose.position)), np.array(parts.xyzw(pose.orientation))
    if not within_bounds([*position, *rotation]) or not abs(np.linalg.norm(rotation) - 1) < 1e-3:
        raise RosError(f"{what} is not finite, is more than 1000 km away, or its quaternion has not length 1")
    return position, unit_quaternions(rotation)


def extrinsics_message(camera: Camera, stamp: int, frame: str, parent: str = WORLD_FRAME) -> TransformStamped:
    """Build ``<camera>/extrinsics``: pose of the optical frame in its parent frame, as tf expects it.

    Args:
        camera: Camera with its pose in the parent frame.
        stamp: Nanoseconds.
        frame: Optical frame of the camera.
        parent: Name of the parent frame.
    """
    return transform_message(camera.center, matrix_to_quaternion(camera.R.T), stamp, parent, frame)


def transform_message(
    position: Array, rotation: Array, stamp: int, frame: str, child: str
) -> TransformStamped:
    """Build a transform between two frames, as tf expects it.

    Args:
        position: Position (3,) of the child frame in the parent frame, metres.
        rotation: Rotation (4,) xyzw of the child frame in the parent frame.
        stamp: Nanoseconds.
        frame: Name of the parent frame.
        child: Name of the child frame.
    """
    transform = Transform(translation=parts.vector(position), rotation=parts.quaternion(rotation))
    return TransformStamped(header=header(stamp, frame), child_frame_id=child, transform=transform)


def read_extrinsics(message: TransformStamped) -> CameraPose:
    """Read an ``<camera>/extrinsics`` message. Raises RosError in the same cases as :func:`read_pose`."""
    position = parts.point(np.array(parts.xyz(message.transform.translation)))
    pose = Pose(position=position, orientation=message.transform.rotation)
    return read_pose(PoseStamped(header=message.header, pose=pose))


def projection_message(camera: Camera) -> Float64MultiArray:
    """Build ``<camera>/projection``: the 3x4 matrix P = K [R | t] from ``map`` to pixels, row by row."""
    message = Float64MultiArray(data=camera.P.ravel().tolist())
    message.layout.dim = [
        MultiArrayDimension(label="rows", size=3, stride=12),
        MultiArrayDimension(label="columns", size=4, stride=4),
    ]
    return message


#: Most triangles of a mesh without a file that are sent with each frame.
_MOST_TRIANGLES = 1000
#: Corners of the triangles of meshes that markers show.
_corners = WeakCache[list[Point]]()
_MARKER_TYPES = {"box": Marker.CUBE, "sphere": Marker.SPHERE, "cylinder": Marker.CYLINDER}


def object_message(scene_object: SceneObject, pose: ObjectPose, stamp: int) -> Marker:
    """Build ``objects/<name>/marker``: a moving object with its pose and size, as RViz shows it.

    RViz reads a mesh file itself. A mesh without a file is sent as triangles, in one colour.
    """
    has_file = Path(scene_object.shape).is_absolute()
    other = Marker.MESH_RESOURCE if has_file else Marker.TRIANGLE_LIST
    shape = _MARKER_TYPES.get(scene_object.shape, other)
    marker = Marker(header=header(stamp, WORLD_FRAME), ns=f"objects/{scene_object.name}", type=shape)
    marker.action = Marker.ADD
    marker.pose, marker.scale = parts.pose(pose.position, pose.rotation), parts.vector(pose.size)
    marker.color = parts.color(scene_object.color)
    if shape == Marker.MESH_RESOURCE:
        marker.mesh_resource = Path(scene_object.shape).as_uri()
    elif shape == Marker.TRIANGLE_LIST:
        marker.points = _triangle_points(scene_object.mesh)
    return marker


def _triangle_points(mesh: Mesh) -> list[Point]:
    """Corners of the triangles of a mesh: three points for each triangle. A mesh with many triangles is
    replaced by its convex hull. The result is kept for each mesh, since a marker is sent with each frame."""
    known = _corners.get(mesh)
    if known is not None:
        return known
    triangles = mesh.triangles
    if len(triangles) > _MOST_TRIANGLES:
        triangles = scipy.spatial.ConvexHull(mesh.vertices).simplices
    return _corners.put(mesh, parts.points(mesh.vertices[triangles].reshape(-1, 3)))


def read_object(message: Marker) -> ObjectPose:
    """Read the object pose of a ``marker`` message. Raises RosError if a number is not finite or a size is
    zero."""
    position, rotation = parts.xyz(message.pose.position), parts.xyzw(message.pose.orientation)
    pose = ObjectPose(np.array(position), np.array(rotation), np.array(parts.xyz(message.scale)))
    if not within_bounds([*pose.position, *pose.rotation, *pose.size]):
        raise RosError("an object's pose or size is not finite, or above 1000 km")
    if not abs(np.linalg.norm(pose.rotation) - 1) < 1e-3 or not (pose.size > 0).all():
        raise RosError("an object's quaternion has not length 1, or its size is 0")
    return pose


def twist_message(velocity: Velocity | None, stamp: int) -> TwistStamped:
    """Build ``objects/<name>/twist`` or ``<camera>/twist``: velocity in the axes of ``map``. An unknown
    velocity is NaN."""
    linear, angular = (np.full(3, np.nan),) * 2 if velocity is None else (velocity.linear, velocity.angular)
    return TwistStamped(header=header(stamp, WORLD_FRAME), twist=parts.twist(linear, angular))


def read_twist(message: TwistStamped) -> Velocity | None:
    """Read the velocity of a ``twist`` message. None if the velocity is not finite, or beyond the bounds of
    :mod:`humansim_ros.errors`."""
    linear, angular = (np.array(parts.xyz(part)) for part in (message.twist.linear, message.twist.angular))
    return Velocity(linear, angular) if within_bounds([*linear, *angular]) else None
