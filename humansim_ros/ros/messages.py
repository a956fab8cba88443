"""Every message this package sends is made here, and read back here: live nodes, recordings and tests share
it.

Standard messages only. Stamps are integer nanoseconds, world poses are in ``map``, metres (REP-103, REP-105).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Twist,
    TwistStamped,
    Vector3,
)
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image, MultiDOFJointState, PointCloud2, PointField
from shape_msgs.msg import Mesh as MeshMessage
from shape_msgs.msg import MeshTriangle
from std_msgs.msg import ColorRGBA, Float64MultiArray, Header, MultiArrayDimension, String
from visualization_msgs.msg import Marker, MarkerArray

from humansim_ros.body import Skeleton
from humansim_ros.camera import Camera
from humansim_ros.camera.region import Region
from humansim_ros.errors import RosError
from humansim_ros.humans.human import Human
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.motion.world_motion import JointPoses, Velocity
from humansim_ros.rotations import matrix_to_quaternion, quaternion_to_matrix
from humansim_ros.scene import HumanState
from humansim_ros.scene.camera import CameraPose
from humansim_ros.scene.live import JointSource
from humansim_ros.scene.objects import ObjectPose, SceneObject
from humansim_ros.scene.state import JointMotion
from humansim_ros.truth.boxes import BodyBox
from humansim_ros.truth.joints import (
    NOTHING,
    OCCLUDED,
    OUTSIDE,
    PERSON,
    SELF,
    THING,
    VISIBLE,
    JointView,
)
from humansim_ros.types import Array

WORLD_FRAME = "map"

#: Image encodings of the channels but rgb, which the sensor decides (docs/ground_truth.md).
ENCODINGS = {
    "depth": "32FC1",
    "instance": "mono16",
    "part": "mono8",
    "face": "32SC1",
    "normal": "32FC3",
    "uv": "32FC2",
    "flow": "32FC2",
    "flow_hidden": "mono8",
    "flow_back": "32FC2",
    "flow_back_hidden": "mono8",
    "alpha": "mono8",
    "amodal": "mono8",
    "shadow": "mono8",
}

#: One point of ``<camera>/joints``; padded so that points start at multiples of four bytes.
JOINT_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "u", "v", "visible", "occluder", "human", "joint", "by", "behind"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<f4", "u1", "u1", "<u2", "<u2", "<u2", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 20, 21, 22, 24, 26, 28],
        "itemsize": 32,
    }
)
#: One point of ``<camera>/boxes``: left, top, right and bottom of the visible pixels and of the whole body.
BOX_POINT = np.dtype(
    [(name, "<f4") for name in ("left", "top", "right", "bottom")]
    + [(name, "<f4") for name in ("whole_left", "whole_top", "whole_right", "whole_bottom")]
    + [("truncation", "<f4"), ("visible_fraction", "<f4"), ("pixels", "<u4")]
    + [("instance", "<u2"), ("kind", "u1")],
    align=True,
)
#: What field ``kind`` of these says.
KINDS = {"human": 1, "object": 2}
#: One point of ``<camera>/visible_vertices``: ``vertex`` in the order of ``humans/<id>/vertices``.
VISIBLE_VERTEX = np.dtype([("vertex", "<u4"), ("instance", "<u2")], align=True)
_ALL_OF_IT = Region()
_VERTEX_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
#: Metres from the origin beyond which nobody is; m/s and rad/s that nobody has.
_FARTHEST = 1e6
_MARKER_TYPES = {"box": Marker.CUBE, "sphere": Marker.SPHERE, "cylinder": Marker.CYLINDER}
_FIELD_TYPES = {
    np.dtype("<f4"): PointField.FLOAT32,
    np.dtype("u1"): PointField.UINT8,
    np.dtype("<u2"): PointField.UINT16,
    np.dtype("<u4"): PointField.UINT32,
}


def optical_frame(camera: str) -> str:
    """Frame of a camera's pixels: z forward, x right, y down (REP-103)."""
    return f"{camera}_optical_frame"


def to_time(nanoseconds: int) -> Time:
    seconds, rest = divmod(nanoseconds, 1_000_000_000)
    return Time(sec=seconds, nanosec=rest)


def to_nanoseconds(stamp: Time) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def serialised_stamp(data: bytes) -> int:
    """Nanoseconds of a serialised message that begins with a header (after four bytes on its encoding)."""
    seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def header(stamp: int, frame: str) -> Header:
    return Header(stamp=to_time(stamp), frame_id=frame)


# --- joints
# -----------------------------------------------------------------------------------------------------


def motion_message(poses: JointPoses, stamp: int) -> MultiDOFJointState:
    """``humans/<id>/motion``: the joints of the motion, from poses with N = 1."""
    linear = None if poses.linear is None else poses.linear[0]
    angular = None if poses.angular is None else poses.angular[0]
    return _joint_state(poses.names, poses.positions[0], poses.rotations[0], linear, angular, stamp)


def joints_message(state: HumanState, stamp: int) -> MultiDOFJointState:
    """``humans/<id>/joints``: the pose and velocity of every joint of the body, the ground truth of a
    tracker.
    """
    rotations = matrix_to_quaternion(state.joints[:, :3, :3])
    return _joint_state(state.joint_names, state.positions, rotations, state.linear, state.angular, stamp)


def _joint_state(
    names: Sequence[str],
    positions: Array,
    rotations: Array,
    linear: Array | None,
    angular: Array | None,
    stamp: int,
) -> MultiDOFJointState:
    message = MultiDOFJointState(header=header(stamp, WORLD_FRAME), joint_names=list(names))
    message.transforms = [
        Transform(
            translation=Vector3(x=p[0], y=p[1], z=p[2]), rotation=Quaternion(x=q[0], y=q[1], z=q[2], w=q[3])
        )
        for p, q in zip(positions.tolist(), rotations.tolist(), strict=True)
    ]
    if linear is not None and angular is not None:
        message.twist = [
            Twist(linear=Vector3(x=v[0], y=v[1], z=v[2]), angular=Vector3(x=w[0], y=w[1], z=w[2]))
            for v, w in zip(linear.tolist(), angular.tolist(), strict=True)
        ]
    return message


def read_joints(message: MultiDOFJointState) -> JointPoses:
    """Joint poses (N = 1) of a ``motion`` or ``joints`` message. RosError where its arrays do not fit or are
    not finite, or it is not in ``map``. Velocities that are not finite are not known.
    """
    if message.header.frame_id != WORLD_FRAME:
        raise RosError(f"joints must be in {WORLD_FRAME}, these are in {message.header.frame_id!r}")
    names = tuple(message.joint_names)
    positions = np.array([(t.translation.x, t.translation.y, t.translation.z) for t in message.transforms])
    rotations = np.array(
        [(t.rotation.x, t.rotation.y, t.rotation.z, t.rotation.w) for t in message.transforms]
    )
    if len(positions) != len(names) or not names:
        raise RosError(f"{len(names)} joint names but {len(positions)} transforms")
    length = np.linalg.norm(rotations, axis=1)
    if not length.any():  # a source that knows no rotations may leave them unset
        rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(names), 1))
        length = np.ones(len(names))
    near = (np.abs(positions) < _FARTHEST).all()  # False for NaN, too
    if not (near and np.isfinite(length).all() and (length > 0.5).all()):
        raise RosError("a joint's pose is not finite or its quaternion has no length")
    linear = angular = None
    if len(message.twist) == len(names):
        linear = np.array([[(t.linear.x, t.linear.y, t.linear.z) for t in message.twist]])
        angular = np.array([[(t.angular.x, t.angular.y, t.angular.z) for t in message.twist]])
        if not ((np.abs(linear) < _FARTHEST).all() and (np.abs(angular) < _FARTHEST).all()):
            linear = angular = None
    return JointPoses(names, positions[None], (rotations / length[:, None])[None], linear, angular)


def joint_motion(poses: JointPoses) -> JointMotion:
    """The joints of a ``joints`` message that has been read."""
    joints = np.broadcast_to(np.eye(4), (len(poses.names), 4, 4)).copy()
    joints[:, :3, :3] = quaternion_to_matrix(poses.rotations[0])
    joints[:, :3, 3] = poses.positions[0]
    if poses.linear is None or poses.angular is None:
        return JointMotion(joints, None, None)
    return JointMotion(joints, poses.linear[0], poses.angular[0])


# --- surfaces
# ---------------------------------------------------------------------------------------------------


def vertices_message(vertices: NDArray[np.float32], stamp: int) -> PointCloud2:
    """``humans/<id>/vertices``: x y z of every vertex in mesh order."""
    points = np.ascontiguousarray(vertices, dtype="<f4").view(_VERTEX_POINT).ravel()
    return _point_cloud(points, header(stamp, WORLD_FRAME))


def read_vertices(message: PointCloud2) -> NDArray[np.float32]:
    """(V, 3) float32 of a ``vertices`` message. RosError where it is not laid out as one."""
    layout = [(f.name, f.offset, f.datatype) for f in message.fields[:3]]
    expected = [(name, 4 * i, PointField.FLOAT32) for i, name in enumerate("xyz")]
    data = np.frombuffer(message.data, dtype=np.uint8)
    count = message.width * message.height
    if layout != expected or message.is_bigendian or len(data) != count * message.point_step:
        raise RosError("vertices must be a PointCloud2 with x y z float32 first, little-endian")
    rows = data.reshape(count, message.point_step)[:, :12]
    return np.ascontiguousarray(rows).view("<f4").reshape(count, 3)


def _point_cloud(points: NDArray[Any], head: Header) -> PointCloud2:
    dtype = points.dtype
    assert dtype.fields is not None
    message = PointCloud2(header=head, height=1, width=len(points), is_bigendian=False, is_dense=True)
    message.fields = [
        PointField(name=name, offset=field[1], datatype=_FIELD_TYPES[field[0]], count=1)
        for name, field in dtype.fields.items()
    ]
    message.point_step = dtype.itemsize
    message.row_step = dtype.itemsize * len(points)
    _fill(message, points)
    return message


def mesh_message(mesh: Mesh) -> MeshMessage:
    """``humans/<id>/mesh``: the surface at rest in body space (y up, facing +z), triangles in mesh order."""
    message = MeshMessage()
    message.vertices = [Point(x=x, y=y, z=z) for x, y, z in mesh.vertices.tolist()]
    message.triangles = [
        MeshTriangle(vertex_indices=np.array(t, dtype=np.uint32)) for t in mesh.triangles.tolist()
    ]
    return message


class MarkerMaker:
    """``humans/<id>/markers``: bones, joints and a coarse skin for RViz and Foxglove.

    A viewer needs no 26,000 triangles: vertices are merged into cells of a few centimetres once, at rest.
    """

    def __init__(self, human: Human, cell: float = 0.035) -> None:
        self._skeleton = human.skeleton
        self._triangles = _coarse_triangles(human.mesh, cell)

    def __call__(self, name: str, instance: int, state: HumanState, stamp: int) -> MarkerArray:
        joints = state.positions
        ends = joints.copy()[: len(self._skeleton)]
        ends += state.joints[: len(self._skeleton), :3, 1] * state.size * self._skeleton.lengths[:, None]
        bones = np.stack([joints[: len(self._skeleton)], ends], axis=1).reshape(-1, 3)
        skin = state.vertices[self._triangles].reshape(-1, 3)
        kinds = (
            ("skeleton", Marker.LINE_LIST, bones, 0.012, (0.95, 0.75, 0.15, 1.0)),
            ("joints", Marker.SPHERE_LIST, joints, 0.03, (0.9, 0.25, 0.2, 1.0)),
            ("skin", Marker.TRIANGLE_LIST, skin, 1.0, (0.75, 0.65, 0.6, 0.6)),
        )
        markers = []
        for kind, shape, points, scale, color in kinds:
            marker = Marker(header=header(stamp, WORLD_FRAME), ns=f"{name}/{kind}", id=instance, type=shape)
            marker.action = Marker.ADD
            marker.pose.orientation.w = 1.0
            marker.scale = Vector3(x=scale, y=scale, z=scale)
            marker.color = ColorRGBA(r=color[0], g=color[1], b=color[2], a=color[3])
            marker.points = [Point(x=x, y=y, z=z) for x, y, z in points.tolist()]
            markers.append(marker)
        return MarkerArray(markers=markers)


def _coarse_triangles(mesh: Mesh, cell: float) -> NDArray[np.intp]:
    """(N, 3) vertex indices of the mesh with all vertices of a cell replaced by one of them."""
    cells = np.floor(mesh.vertices / cell).astype(np.int64)
    _, first, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    merged = first[inverse.ravel()][mesh.triangles]
    whole = (merged[:, 0] != merged[:, 1]) & (merged[:, 1] != merged[:, 2]) & (merged[:, 2] != merged[:, 0])
    kept = merged[whole]
    _, once = np.unique(np.sort(kept, axis=1), axis=0, return_index=True)
    return kept[np.sort(once)]


def object_message(thing: SceneObject, pose: ObjectPose, stamp: int) -> Marker:
    """``objects/<name>/marker``: an object that moves, with its pose and size, as RViz shows it."""
    shape = _MARKER_TYPES.get(thing.shape, Marker.MESH_RESOURCE)
    marker = Marker(header=header(stamp, WORLD_FRAME), ns=f"objects/{thing.name}", type=shape)
    marker.action = Marker.ADD
    x, y, z = pose.position.tolist()
    qx, qy, qz, qw = pose.rotation.tolist()
    marker.pose = Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))
    marker.scale = Vector3(**dict(zip("xyz", pose.size.tolist(), strict=True)))
    red, green, blue = (c / 255 for c in thing.color)
    marker.color = ColorRGBA(r=red, g=green, b=blue, a=1.0)
    if shape == Marker.MESH_RESOURCE:
        marker.mesh_resource = Path(thing.shape).as_uri()
    return marker


def read_object(message: Marker) -> ObjectPose:
    """Where the object of a ``marker`` message is. RosError where that is not finite or has no size."""
    p, q, s = message.pose.position, message.pose.orientation, message.scale
    pose = ObjectPose(np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w]), np.array([s.x, s.y, s.z]))
    finite = all(np.isfinite(part).all() for part in (pose.position, pose.rotation, pose.size))
    if not finite or abs(np.linalg.norm(pose.rotation) - 1) > 1e-3 or not (pose.size > 0).all():
        raise RosError("an object's pose is not finite, its quaternion has not length 1, or its size is 0")
    return pose


def twist_message(velocity: Velocity | None, stamp: int) -> TwistStamped:
    """``objects/<name>/twist``, ``<camera>/twist``: how something moves, in the axes of ``map``; NaN if that
    is not known.
    """
    linear, angular = (np.full(3, np.nan),) * 2 if velocity is None else (velocity.linear, velocity.angular)
    message = TwistStamped(header=header(stamp, WORLD_FRAME))
    for part, value in ((message.twist.linear, linear), (message.twist.angular, angular)):
        part.x, part.y, part.z = value.tolist()
    return message


def read_twist(message: TwistStamped) -> Velocity | None:
    """What a ``twist`` message says; None if that is not finite."""
    parts = message.twist.linear, message.twist.angular
    linear, angular = (np.array([part.x, part.y, part.z]) for part in parts)
    return Velocity(linear, angular) if np.isfinite([*linear, *angular]).all() else None


# --- cameras
# ----------------------------------------------------------------------------------------------------


def image_message(image: NDArray[Any], encoding: str, stamp: int, frame: str) -> Image:
    """An image (H, W) or (H, W, C) with the given ROS encoding; the array is not copied and must not change
    after.
    """
    message = Image(
        header=header(stamp, frame), height=image.shape[0], width=image.shape[1], encoding=encoding
    )
    message.is_bigendian = 0
    message.step = image.strides[0]
    _fill(message, image)
    return message


def _fill(message: Any, data: NDArray[Any]) -> None:
    """Put bytes into ``message.data`` as they are: assigning to ``data`` would check them one by one."""
    message._data = np.ascontiguousarray(data).reshape(-1).view(np.uint8)


def camera_info_message(camera: Camera, stamp: int, frame: str, region: Region = _ALL_OF_IT) -> CameraInfo:
    """``<camera>/camera_info`` of a whole sensor's camera, of which images show a region.

    As drivers have it, size, K, D, R and P are those of the whole sensor. OpenCV and image_geometry read no
    skew from K, which has it all the same; P has none.
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
    """The camera of a CameraInfo, at the origin. CameraError where it cannot be one."""
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


def pose_message(pose: CameraPose, stamp: int) -> PoseStamped:
    """``<camera>/pose``: where the optical frame of a camera that moves is in ``map``."""
    message = PoseStamped(header=header(stamp, WORLD_FRAME))
    x, y, z = (-pose.R.T @ pose.t).tolist()
    message.pose.position = Point(x=x, y=y, z=z)
    x, y, z, w = matrix_to_quaternion(pose.R.T).tolist()
    message.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
    return message


def read_pose(message: PoseStamped) -> CameraPose:
    """The pose of a ``pose`` message. RosError where it is not in ``map``, not finite or no rotation."""
    if message.header.frame_id != WORLD_FRAME:
        raise RosError(f"a camera's pose must be in {WORLD_FRAME}, this is in {message.header.frame_id!r}")
    p, q = message.pose.position, message.pose.orientation
    position, rotation = np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])
    near = (np.abs(position) < _FARTHEST).all()  # False for NaN, too
    if not near or not abs(np.linalg.norm(rotation) - 1) < 1e-3:
        raise RosError("a camera's pose is not finite, or its quaternion has not length 1")
    r = quaternion_to_matrix(rotation / np.linalg.norm(rotation)).T
    return CameraPose(r, -r @ position)


def extrinsics_message(name: str, camera: Camera, stamp: int) -> TransformStamped:
    """``<camera>/extrinsics``: pose of the optical frame in ``map``, as tf has it."""
    message = TransformStamped(header=header(stamp, WORLD_FRAME), child_frame_id=optical_frame(name))
    x, y, z = camera.center.tolist()
    message.transform.translation = Vector3(x=x, y=y, z=z)
    x, y, z, w = matrix_to_quaternion(camera.R.T).tolist()
    message.transform.rotation = Quaternion(x=x, y=y, z=z, w=w)
    return message


def projection_message(camera: Camera) -> Float64MultiArray:
    """``<camera>/projection``: the 3x4 matrix P = K [R | t], row by row, from ``map`` to pixels."""
    message = Float64MultiArray(data=camera.P.ravel().tolist())
    message.layout.dim = [
        MultiArrayDimension(label="rows", size=3, stride=12),
        MultiArrayDimension(label="columns", size=4, stride=4),
    ]
    return message


def joint_view_message(views: Sequence[tuple[int, JointView]], stamp: int, frame: str) -> PointCloud2:
    """``<camera>/joints``: the joints of all humans, as pairs of instance label and view."""
    points = np.zeros(sum(len(view.visible) for _, view in views), dtype=JOINT_POINT)
    start = 0
    for instance, view in views:
        part = points[start : start + len(view.visible)]
        for i, axis in enumerate("xyz"):
            part[axis] = view.optical[:, i]
        part["u"], part["v"] = view.pixels[:, 0], view.pixels[:, 1]
        part["visible"], part["human"], part["joint"] = view.visible, instance, np.arange(len(part))
        part["occluder"], part["by"], part["behind"] = view.occluder, view.by, view.behind
        start += len(part)
    message = _point_cloud(points, header(stamp, frame))
    message.is_dense = bool(np.isfinite(points["u"]).all())
    return message


def read_joint_view(message: PointCloud2) -> NDArray[Any]:
    """The points of a ``<camera>/joints`` message as a structured array (:data:`JOINT_POINT`; recordings of
    earlier versions lack some of its fields). RosError where it is not laid out as one.
    """
    return _read_points(message, ("x", "y", "z", "u", "v", "visible", "human", "joint"))


def boxes_message(boxes: Sequence[tuple[int, BodyBox]], stamp: int, frame: str) -> PointCloud2:
    """``<camera>/boxes``: one point per human and labelled object, from pairs of instance label and boxes."""
    points = np.zeros(len(boxes), dtype=BOX_POINT)
    for point, (instance, box) in zip(points, boxes, strict=True):
        shares = (box.truncation, box.visible_fraction, box.pixels)
        values = (*box.visible, *box.whole, *shares, instance, KINDS[box.kind])
        for name, value in zip(BOX_POINT.names or (), values, strict=True):
            point[name] = value
    message = _point_cloud(points, header(stamp, frame))
    message.is_dense = all(bool(np.isfinite(points[name]).all()) for name in BOX_POINT.names or ())
    return message


def read_boxes(message: PointCloud2) -> NDArray[Any]:
    """The points of a ``<camera>/boxes`` message as a structured array (:data:`BOX_POINT`). RosError where it
    is not laid out as one.
    """
    return _read_points(message, BOX_POINT.names or ())


def visible_vertices_message(
    seen: Sequence[tuple[int, NDArray[np.bool_]]], stamp: int, frame: str
) -> PointCloud2:
    """``<camera>/visible_vertices``: one point per vertex that is seen, from pairs of instance label and
    which of the body's vertices (V,) are.
    """
    numbers = [np.flatnonzero(mask) for _, mask in seen]
    points = np.zeros(sum(map(len, numbers)), dtype=VISIBLE_VERTEX)
    if len(points):
        points["vertex"] = np.concatenate(numbers)
        points["instance"] = np.repeat([instance for instance, _ in seen], [len(n) for n in numbers])
    return _point_cloud(points, header(stamp, frame))


def read_visible_vertices(message: PointCloud2) -> NDArray[Any]:
    """The points of a ``<camera>/visible_vertices`` message as a structured array (:data:`VISIBLE_VERTEX`).
    RosError where it is not laid out as one.
    """
    return _read_points(message, VISIBLE_VERTEX.names or ())


def _read_points(message: PointCloud2, needed: Sequence[str]) -> NDArray[Any]:
    """(N,) structured array of a cloud's points, as its fields say."""
    kinds = {number: kind for kind, number in _FIELD_TYPES.items()}
    fields = [f for f in message.fields if f.datatype in kinds and f.count == 1]
    missing = set(needed) - {f.name for f in fields}
    if missing or message.is_bigendian:
        lacks = f"the fields {', '.join(sorted(missing))}" if missing else "little-endian numbers"
        raise RosError(f"a PointCloud2 lacks {lacks}")
    data, count = np.frombuffer(message.data, dtype=np.uint8), message.width * message.height
    try:
        dtype = np.dtype(
            {
                "names": [f.name for f in fields],
                "formats": [kinds[f.datatype] for f in fields],
                "offsets": [f.offset for f in fields],
                "itemsize": message.point_step,
            }
        )
    except ValueError as reason:  # fields beyond the point, or two of one name
        raise RosError(f"the fields of a PointCloud2 are impossible: {reason}") from None
    if len(data) != count * dtype.itemsize:
        raise RosError(f"{len(data)} bytes are not {count} points of {dtype.itemsize}")
    return data.view(dtype)


# --- legends
# ----------------------------------------------------------------------------------------------------


def motion_legend(source: JointSource) -> String:
    """``humans/<id>/motion/legend``: how the joints of the motion are put onto the human's skeleton."""
    return _legend(source.to_dict())


def read_motion_legend(message: String) -> dict[str, Any]:
    """What a ``motion/legend`` message says. RosError if it is not JSON."""
    try:
        data = json.loads(message.data)
    except ValueError as reason:
        raise RosError(f"a legend must be JSON: {reason}") from None
    if not isinstance(data, dict):
        raise RosError("a legend must be a JSON object")
    return data


def instance_legend(labels: Mapping[str, int]) -> String:
    """``<camera>/instance/legend``: which pixel value is which human or object."""
    return _legend({"0": "background"} | _by_label(labels))


def part_legend(skeleton: Skeleton) -> String:
    """``<camera>/part/legend``: which pixel value is which bone."""
    return _legend({"0": "background"} | {str(i): name for i, name in enumerate(skeleton.names, 1)})


def joints_legend(
    humans: Mapping[str, tuple[int, Sequence[str]]], objects: Mapping[str, int] = MappingProxyType({})
) -> String:
    """``<camera>/joints/legend``: names of the fields ``human``, ``joint``, ``visible`` and ``occluder``;
    those of ``by`` are in ``human`` and ``object``. ``objects``: instance labels of objects by name.
    """
    return _legend(
        {
            "human": _by_label({name: label for name, (label, _) in humans.items()}),
            "object": _by_label(objects),
            "joint": {name: list(joints) for name, (_, joints) in humans.items()},
            "visible": {str(OUTSIDE): "outside", str(OCCLUDED): "occluded", str(VISIBLE): "visible"},
            "occluder": {
                str(NOTHING): "nothing",
                str(SELF): "self",
                str(PERSON): "person",
                str(THING): "thing",
            },
        }
    )


def _by_label(labels: Mapping[str, int]) -> dict[str, str]:
    return {str(label): name for name, label in labels.items()}


def _legend(content: Any) -> String:
    return String(data=json.dumps(content))
