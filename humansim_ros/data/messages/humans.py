"""Messages of topics ``humans/<id>/…``: motion, joints, vertices, mesh and markers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from humansim_ros.data.messages import parts
from humansim_ros.data.messages.cdr import unpack
from humansim_ros.data.messages.headers import WORLD_FRAME, header
from humansim_ros.data.messages.points import point_cloud
from humansim_ros.data.messages.types import (
    ColorRGBA,
    JointState,
    Marker,
    MarkerArray,
    MeshTriangle,
    MultiDOFJointState,
    PointCloud2,
    PointField,
    Transform,
    Vector3,
)
from humansim_ros.data.messages.types import Mesh as MeshMessage
from humansim_ros.errors import RosError, within_bounds
from humansim_ros.files.mesh import Mesh
from humansim_ros.geometry import quaternion_to_matrix, transform, unit_quaternions
from humansim_ros.motion.body import JointPoses, Rated
from humansim_ros.people.humans import Human
from humansim_ros.scene.truth import HumanState
from humansim_ros.types import Array, Float32Array, Indices

#: Most joints of a motion, and most characters of the name of a joint.
MAX_JOINTS, MAX_NAME = 1024, 256
#: Length of the longest message of a mesh that is read, bytes.
_MAX_MESH = 32 << 20
_VERTEX_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])


def motion_message(poses: JointPoses, stamp: int) -> MultiDOFJointState:
    """Build ``humans/<id>/motion`` from the poses (N = 1) of the joints of a motion."""
    linear = None if poses.linear is None else poses.linear[0]
    angular = None if poses.angular is None else poses.angular[0]
    return _joint_state(poses.names, poses.positions[0], poses.rotations[0], linear, angular, stamp)


def joints_message(state: HumanState, stamp: int) -> MultiDOFJointState:
    """Build ``humans/<id>/joints``: pose and velocity of every joint of the body."""
    return _joint_state(
        state.joint_names, state.positions, state.rotations, state.linear, state.angular, stamp
    )


def keypoints_message(names: Sequence[str], positions: Array, stamp: int) -> MultiDOFJointState:
    """Build ``humans/<id>/keypoints/<set>`` from positions (K, 3) in ``map``. Keypoints have no orientation
    and no velocity."""
    return _joint_state(names, positions, np.tile([0.0, 0.0, 0.0, 1.0], (len(names), 1)), None, None, stamp)


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
        Transform(translation=parts.vector(position), rotation=parts.quaternion(rotation))
        for position, rotation in zip(positions, rotations, strict=True)
    ]
    if linear is not None and angular is not None:
        message.twist = list(map(parts.twist, linear, angular))
    return message


def read_joints(message: MultiDOFJointState) -> JointPoses:
    """Read the joint poses (N = 1) of a ``motion`` or ``joints`` message.

    Velocities that are not finite, or beyond the bounds of :mod:`humansim_ros.errors`, are left out.

    Raises:
        RosError: Array lengths differ, there are too many joints, two have one name, a pose is not finite,
            or the message is not in ``map``.
    """
    if message.header.frame_id != WORLD_FRAME:
        raise RosError(f"joints must be in {WORLD_FRAME}, these are in {message.header.frame_id!r}")
    names = tuple(message.joint_names)
    if len(message.transforms) != len(names) or not names:
        raise RosError(f"{len(names)} joint names but {len(message.transforms)} transforms")
    if len(names) > MAX_JOINTS or max(map(len, names)) > MAX_NAME:
        raise RosError(f"more than {MAX_JOINTS} joints, or a name of more than {MAX_NAME} characters")
    positions = np.array([parts.xyz(each.translation) for each in message.transforms])
    rotations = np.array([parts.xyzw(each.rotation) for each in message.transforms])
    if not (within_bounds(positions) and within_bounds(rotations)):
        raise RosError("a joint's pose is not finite, or is more than 1000 km away")
    length = np.linalg.norm(rotations, axis=1)
    if not length.any():  # a source without rotations may leave them unset
        rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(names), 1))
    elif not (length > 0.5).all():
        raise RosError("a joint's quaternion has no length")
    linear = angular = None
    if len(message.twist) == len(names):
        linear = np.array([[parts.xyz(each.linear) for each in message.twist]])
        angular = np.array([[parts.xyz(each.angular) for each in message.twist]])
        if not (within_bounds(linear) and within_bounds(angular)):
            linear = angular = None
    return JointPoses(names, positions[None], unit_quaternions(rotations)[None], linear, angular)


def human_state(
    poses: JointPoses, vertices: Float32Array, features: Mapping[str, Rated] = MappingProxyType({})
) -> HumanState:
    """Make the state of a human from the poses (N = 1) of a ``joints`` message and from other messages.

    Args:
        poses: Poses of its joints.
        vertices: Vertices (V, 3).
        features: Values that are no joints, such as ``face``, by the name of their topic.
    """
    (rotations,), joints = poses.rotations, transform(quaternion_to_matrix(poses.rotations), poses.positions)
    linear, angular = (None if each is None else each[0] for each in (poses.linear, poses.angular))
    return HumanState(
        poses.names, joints[0], linear, angular, vertices, rotations=rotations, features=features
    )


def rated_message(rated: Rated, stamp: int) -> JointState:
    """Build a message of values that are no joints, as ``humans/<id>/face``: each value and its rate of
    change."""
    message = JointState(header=header(stamp, WORLD_FRAME), name=list(rated.labels))
    message.position, message.velocity = rated.values.ravel().tolist(), rated.rates.ravel().tolist()
    return message


def read_rated(message: JointState, rest: Rated) -> Rated:
    """Read a message of :func:`rated_message`.

    Args:
        message: The message.
        rest: Values at rest, with the labels that the message must have.

    Raises:
        RosError: The message has other labels, or a value is beyond the limits.
    """
    labels, (low, high) = rest.labels, rest.limits
    if tuple(message.name) != labels or not len(message.position) == len(message.velocity) == len(labels):
        raise RosError(
            f"{len(message.name)} names; needed are the {len(labels)} from {labels[0]} to {labels[-1]}, each "
            "with position and velocity"
        )
    values, rates = (
        np.array(part, dtype=float).reshape(rest.values.shape)
        for part in (message.position, message.velocity)
    )
    if not (within_bounds(values) and within_bounds(rates) and ((values >= low) & (values <= high)).all()):
        raise RosError(f"a value is not from {low:g} to {high:g}, or a rate is not finite")
    return replace(rest, values=values, rates=rates)


def vertices_message(vertices: Float32Array, stamp: int) -> PointCloud2:
    """Build ``humans/<id>/vertices``: x y z of the vertices (V, 3) in mesh order."""
    points = np.ascontiguousarray(vertices, dtype="<f4").view(_VERTEX_POINT).ravel()
    return point_cloud(points, header(stamp, WORLD_FRAME))


def read_vertices(message: PointCloud2) -> Float32Array:
    """Read the vertices (V, 3) of a ``vertices`` message.

    Raises:
        RosError: The message has another layout, or a vertex is not finite.
    """
    layout = [(f.name, f.offset, f.datatype) for f in message.fields[:3]]
    expected = [(name, 4 * i, PointField.FLOAT32) for i, name in enumerate("xyz")]
    data = np.frombuffer(message.data, dtype=np.uint8)
    count = message.width * message.height
    whole = message.point_step >= 12 and len(data) == count * message.point_step
    if layout != expected or message.is_bigendian or not whole:
        raise RosError("vertices must be a PointCloud2 with x y z float32 first, little-endian")
    rows = data.reshape(count, message.point_step)[:, :12]
    vertices = np.ascontiguousarray(rows).view("<f4").reshape(count, 3)
    if not within_bounds(vertices):
        raise RosError("a vertex is not finite, or more than 1000 km away")
    return vertices


def mesh_message(mesh: Mesh) -> MeshMessage:
    """Build ``humans/<id>/mesh``: the surface in the rest pose, in body space (y up, facing +z)."""
    triangles = [MeshTriangle(vertex_indices=each) for each in mesh.triangles.astype(np.uint32)]
    return MeshMessage(vertices=parts.points(mesh.vertices), triangles=triangles)


def read_mesh(data: bytes) -> Mesh:
    """Read a serialised ``mesh`` message without rclpy, which would need a second for the mesh of a human.

    Raises:
        RosError: The message is too long, ends too early, or has another length than it states.
        MeshError: A triangle names a vertex that does not exist, or a vertex is not finite.
    """
    if len(data) > _MAX_MESH:
        raise RosError(f"a mesh of {len(data)} bytes; at most {_MAX_MESH} are read")
    (triangles,) = unpack("I", data, 4)
    start = 8 + 12 * triangles
    (vertices,) = unpack("I", data, start)
    points = start + 4 + (-start % 8)  # numbers of 8 bytes begin at multiples of 8 after the first 4 bytes
    if len(data) < points + 24 * vertices:
        raise RosError(f"{len(data)} bytes are no mesh of {vertices} vertices and {triangles} triangles")
    order = "<" if data[1] & 1 else ">"
    corners = np.frombuffer(data, f"{order}u4", 3 * triangles, 8).reshape(-1, 3)
    faces = np.full((triangles, 4), -1, np.int32)
    faces[:, :3] = np.minimum(corners, len(data))  # a number beyond 31 bits is not a vertex either
    positions = np.frombuffer(data, f"{order}f8", 3 * vertices, points).reshape(-1, 3)
    return Mesh(positions.astype(float), faces)


class MarkerBuilder:
    """Builds ``humans/<id>/markers``: bones, joints and a coarse skin for RViz and Foxglove. The skin is
    simplified once, since viewers are slow with 26,000 triangles: vertices of the rest pose that lie in the
    same cube with a side of ``cell`` metres are merged."""

    def __init__(self, human: Human, cell: float = 0.035) -> None:
        self._skeleton = human.skeleton
        self._triangles = _coarse_triangles(human.mesh, cell)
        bones = np.array(self._skeleton.joint_bones)
        # spheres would hide fingers, eyes and jaw
        self._spheres = np.flatnonzero(self._skeleton.wholes[bones] == bones)

    def build(self, name: str, instance: int, state: HumanState, stamp: int) -> MarkerArray:
        """Build the markers of one frame.

        Args:
            name: Name of the human, in the namespaces of the markers.
            instance: Instance label of the human, the id of the markers.
            state: Body of the human at the stamp.
            stamp: Nanoseconds.
        """
        joints = state.positions
        ends = joints.copy()[: len(self._skeleton)]
        ends += state.joints[: len(self._skeleton), :3, 1] * state.size * self._skeleton.lengths[:, None]
        bones = np.stack([joints[: len(self._skeleton)], ends], axis=1).reshape(-1, 3)
        skin = state.vertices[self._triangles].reshape(-1, 3)
        layers = (
            ("skeleton", Marker.LINE_LIST, bones, 0.012, (0.95, 0.75, 0.15, 1.0)),
            ("joints", Marker.SPHERE_LIST, joints[self._spheres], 0.03, (0.9, 0.25, 0.2, 1.0)),
            ("skin", Marker.TRIANGLE_LIST, skin, 1.0, (0.75, 0.65, 0.6, 0.6)),
        )
        markers = []
        for layer, shape, points, scale, color in layers:
            marker = Marker(header=header(stamp, WORLD_FRAME), ns=f"{name}/{layer}", id=instance, type=shape)
            marker.action = Marker.ADD
            marker.pose.orientation.w = 1.0
            marker.scale = Vector3(x=scale, y=scale, z=scale)
            marker.color = ColorRGBA(r=color[0], g=color[1], b=color[2], a=color[3])
            marker.points = parts.points(points)
            markers.append(marker)
        return MarkerArray(markers=markers)


def _coarse_triangles(mesh: Mesh, cell: float) -> Indices:
    """Merge all vertices of a cell to one. Returns the remaining triangles (N, 3) as vertex indices."""
    cells = np.floor(mesh.vertices / cell).astype(np.int64)
    _, first, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    merged = first[inverse.ravel()][mesh.triangles]
    whole = (merged[:, 0] != merged[:, 1]) & (merged[:, 1] != merged[:, 2]) & (merged[:, 2] != merged[:, 0])
    merged = merged[whole]
    _, once = np.unique(np.sort(merged, axis=1), axis=0, return_index=True)
    return merged[np.sort(once)]
