"""Readers refuse hostile messages with a RosError, at once; accepted ones give finite results."""

from __future__ import annotations

import json
import math
import random
import struct
import zlib
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest

from humansim_ros.cameras import Camera
from humansim_ros.data import messages
from humansim_ros.data.messages.cameras import camera_info_message, object_message
from humansim_ros.data.messages.cdr import MAX_FIELDS, check_serialised, deserialised
from humansim_ros.data.messages.humans import MAX_JOINTS, joints_message, mesh_message, vertices_message
from humansim_ros.data.messages.images import compressed_image_message, read_compressed_image
from humansim_ros.errors import CameraError, HumansimError, MotionError, RosError
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.geometry import ObjectPose
from humansim_ros.motion.body.kinematics import JointPoses
from humansim_ros.scene import Scene
from humansim_ros.scene.core.camera import CameraPose
from humansim_ros.scene.core.live import JointSource, LiveRetargeter

pytest.importorskip("rclpy")
NAN, INF = math.nan, math.inf
#: Numbers that no honest sender sends.
WRONG = (NAN, INF, -INF, 1e300, -1e300, 1e20, 1.0001e6)


@cache
def scene() -> Scene:
    camera = {"position": [3.0, 2.6, 2.0], "look_at": [0, 0, 0.8], "fov_deg": 65}
    first = {"motion": {"file": "walk", "position": [0.0, -1.59], "loop": "continue"}}
    return Scene.from_dict({"room": None, "humans": {"first": first}, "cameras": {"left": camera}})


# --- stamps and serialised messages


@pytest.mark.parametrize(("sec", "nanosec"), [(-1, 0), (-(2**31), 0), (0, 10**9), (5, 2**32 - 1)])
def test_stamps_that_are_no_time_are_refused(sec: int, nanosec: int) -> None:
    from builtin_interfaces.msg import Time
    from rclpy.serialization import serialize_message
    from std_msgs.msg import Header

    stamp = Time(sec=sec, nanosec=nanosec)
    with pytest.raises(RosError, match=f"a stamp of {sec} s and {nanosec} ns is not valid"):
        messages.to_nanoseconds(stamp)
    with pytest.raises(RosError, match="is not valid"):
        messages.serialised_stamp(serialize_message(Header(stamp=stamp)))


@pytest.mark.parametrize("stamp", [0, 1, 1_700_000_000_123_456_789, (2**31 - 1) * 10**9 + 999_999_999])
def test_valid_stamps_return_from_messages_in_both_byte_orders(stamp: int) -> None:
    from rclpy.serialization import serialize_message

    header = messages.header(stamp, "map")
    assert messages.to_nanoseconds(header.stamp) == stamp
    data = serialize_message(header)
    assert messages.serialised_stamp(data) == stamp
    swapped = b"\0\0\0\0" + data[4:8][::-1] + data[8:12][::-1]
    assert messages.serialised_stamp(swapped) == stamp


@pytest.mark.parametrize("kind", ["MultiDOFJointState", "PointCloud2"])
def test_every_truncated_message_is_refused(kind: str) -> None:
    from rclpy.serialization import serialize_message
    from sensor_msgs import msg

    state = scene().actors["first"].at(0.0)
    whole = {
        "MultiDOFJointState": lambda: joints_message(state, 5),
        "PointCloud2": lambda: vertices_message(state.vertices[:9], 5),
    }[kind]()
    data = serialize_message(whole)
    for length in range(len(data) - 4):  # the last bytes may be padding
        with pytest.raises(RosError):
            deserialised(data[:length], getattr(msg, kind))
        if length < 12:
            with pytest.raises(RosError, match="ends too early"):
                messages.serialised_stamp(data[:length])


def test_messages_of_too_many_bytes_or_fields_are_refused_before_they_are_read() -> None:
    from rclpy.serialization import serialize_message
    from sensor_msgs.msg import MultiDOFJointState, PointCloud2, PointField
    from std_msgs.msg import Header, String

    long = [
        MultiDOFJointState(joint_names=[f"joint {number}" for number in range(100_000)]),
        MultiDOFJointState(joint_names=["x" * 1_000_000]),
        String(data="[" * 1_000_000),
        Header(frame_id="x" * 1_000_000),
        PointCloud2(fields=[PointField()] * (MAX_FIELDS + 1)),
    ]
    for message in long:
        with pytest.raises(RosError, match="are read"):
            check_serialised(serialize_message(message), type(message))
    vertices = vertices_message(np.zeros((200_000, 3), dtype=np.float32), 5)
    check_serialised(serialize_message(vertices), PointCloud2)


# --- joints


def joints() -> Any:
    return joints_message(scene().actors["first"].at(0.0), 5)


@pytest.mark.parametrize("value", WRONG)
@pytest.mark.parametrize("part", ["translation.y", "rotation.w"])
def test_joints_with_a_wrong_number_are_refused(part: str, value: float) -> None:
    message = joints()
    holder, axis = part.split(".")
    setattr(getattr(message.transforms[3], holder), axis, value)
    with pytest.raises(RosError, match=r"not finite|no length"):
        messages.read_joints(message)


@pytest.mark.parametrize("value", WRONG)
@pytest.mark.parametrize("part", ["linear", "angular"])
def test_velocities_with_a_wrong_number_are_left_out(part: str, value: float) -> None:
    from geometry_msgs.msg import TwistStamped

    message = joints()
    getattr(message.twist[2], part).z = value
    poses = messages.read_joints(message)
    assert poses.linear is None and poses.angular is None
    twist = TwistStamped()
    getattr(twist.twist, part).x = value
    assert messages.read_twist(twist) is None


def test_joints_without_names_of_their_own_or_with_too_many_are_refused() -> None:
    from geometry_msgs.msg import Transform
    from sensor_msgs.msg import MultiDOFJointState

    def message(names: list[str], transforms: int | None = None) -> Any:
        out = MultiDOFJointState(joint_names=names)
        out.header.frame_id = "map"
        out.transforms = [Transform()] * (len(names) if transforms is None else transforms)
        return out

    wrong = [
        (message([]), "0 joint names"),
        (message(["a", "b"], 1), "2 joint names but 1 transforms"),
        (message([str(n) for n in range(MAX_JOINTS + 1)]), f"more than {MAX_JOINTS} joints"),
        (message(["x" * 257]), "a name of more than 256 characters"),
    ]
    for each, text in wrong:
        with pytest.raises(RosError, match=text):
            messages.read_joints(each)
    poses = messages.read_joints(message([*map(str, range(MAX_JOINTS - 1)), "0"]))
    with pytest.raises(MotionError, match="joint names appear twice: 0"):
        LiveRetargeter(scene().actors["first"]).retarget(poses)


# --- vertices, objects, poses


def vertices(**changes: Any) -> Any:
    message = vertices_message(np.ones((6, 3), dtype=np.float32), 5)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


@pytest.mark.parametrize(
    "changes",
    [{"point_step": step} for step in (0, 1, 4, 11, 13, 2**32 - 1)]
    + [
        {"width": 2**32 - 1, "height": 2**32 - 1},
        {"width": 2**31, "height": 2, "point_step": 0},
        {"width": 0},
        {"width": 2**32 - 1, "point_step": 0, "data": b""},
        {"point_step": 8, "width": 9},
        {"is_bigendian": True},
        {"fields": []},
        {"data": b""},
    ],
    ids=str,
)
def test_vertices_of_another_layout_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(RosError, match="x y z float32 first"):
        messages.read_vertices(vertices(**changes))


@pytest.mark.parametrize("value", WRONG)
def test_vertices_with_a_wrong_number_are_refused(value: float) -> None:
    points = np.ones((6, 3), dtype=np.float32)
    with np.errstate(over="ignore"):
        points[4, 1] = value
    with pytest.raises(RosError, match="a vertex is not finite"):
        messages.read_vertices(vertices_message(points, 5))


def test_point_clouds_with_impossible_fields_are_refused() -> None:
    from sensor_msgs.msg import PointField

    field = PointField(name="x", datatype=PointField.FLOAT32, count=1)
    far = PointField(name="x", offset=2**32 - 1, datatype=PointField.FLOAT32, count=1)
    for changes in ({"fields": [field, field]}, {"fields": [far]}, {"point_step": 0}, {"width": 2**32 - 1}):
        with pytest.raises(RosError):
            messages.read_points(vertices(**changes), ("x",))


def test_a_field_at_the_end_of_31_bits_is_refused() -> None:
    """NumPy 2.4 accepts a byte there as within the point, and reads memory of others when a row is taken."""
    from sensor_msgs.msg import PointField

    fields = [
        PointField(name="x", datatype=PointField.FLOAT32, count=1),
        PointField(name="kind", offset=2**31 - 1, datatype=PointField.UINT8, count=1),
    ]
    with pytest.raises(RosError, match="field kind ends after byte 12 of a point"):
        messages.read_points(vertices(fields=fields), ("x",))


@pytest.mark.parametrize(
    ("part", "value"),
    [
        *((part, value) for part in ("pose.position", "pose.orientation", "scale") for value in WRONG),
        *(("scale", value) for value in (0.0, -1.0)),
    ],
)
def test_objects_with_a_wrong_number_are_refused(part: str, value: float) -> None:
    pose = ObjectPose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.ones(3))
    item = scene_object()
    message = object_message(item, pose, 5)
    messages.read_object(message)
    holder: Any = message
    for name in part.split("."):
        holder = getattr(holder, name)
    holder.x = value
    with pytest.raises(RosError, match=r"not finite|length 1|size is 0"):
        messages.read_object(message)


@cache
def scene_object() -> Any:
    keyframes = {"position": [0.0, 0.0, 0.5]}
    made = Scene.from_dict(
        {"objects": {"box": keyframes}, "cameras": {"c": {"position": [3, 0, 1], "look_at": [0, 0, 1]}}}
    )
    return made.objects["box"] if isinstance(made.objects, dict) else next(iter(made.objects))


@pytest.mark.parametrize("value", WRONG)
@pytest.mark.parametrize("part", ["position", "orientation"])
def test_camera_poses_with_a_wrong_number_are_refused(part: str, value: float) -> None:
    message = messages.pose_message(CameraPose.of(scene().cameras["left"]), 5)
    messages.read_pose(message)
    getattr(message.pose, part).z = value
    with pytest.raises(RosError, match="not finite"):
        messages.read_pose(message)


# --- calibrations


def calibration() -> Any:
    camera = Camera.look_at((3, 0, 1), (0, 0, 1), (160, 120))
    message = camera_info_message(camera, 5, "frame")
    for name in "krp":
        setattr(message, name, list(map(float, getattr(message, name))))
    return message


def with_number(name: str, index: int, value: float) -> Any:
    message = calibration()
    numbers = list(getattr(message, name))
    numbers[index] = value
    setattr(message, name, numbers)
    return message


@pytest.mark.parametrize("value", WRONG)
@pytest.mark.parametrize(("name", "index"), [("k", 0), ("k", 2), ("k", 3), ("r", 0), ("p", 0), ("p", 3)])
def test_calibrations_with_a_wrong_number_are_refused(name: str, index: int, value: float) -> None:
    with pytest.raises(CameraError):
        messages.read_camera_info(with_number(name, index, value))


@pytest.mark.parametrize("value", WRONG)
@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial", "equidistant", ""])
def test_lenses_with_a_wrong_number_are_refused(model: str, value: float) -> None:
    message = calibration()
    message.distortion_model, message.d = model, [0.1, value, 0.0, 0.0]
    with pytest.raises(CameraError):
        messages.read_camera_info(message)


@pytest.mark.parametrize(
    "changes",
    [
        {"width": 0},
        {"width": 2**32 - 1, "height": 2**32 - 1},
        {"d": [0.1] * 1_000_000},
        {"distortion_model": "x" * 1_000_000},
        {"distortion_model": "\x1b[2J"},
    ],
    ids=lambda changes: str(changes)[:30],
)
def test_calibrations_of_impossible_sizes_are_refused(changes: dict[str, Any]) -> None:
    message = calibration()
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(CameraError) as caught:
        messages.read_camera_info(message)
    assert len(str(caught.value)) < 500


# --- legends


def legend() -> dict[str, Any]:
    return JointSource.of_actor(scene().actors["first"]).to_dict()


def read(text: str) -> JointSource:
    from std_msgs.msg import String

    return JointSource.from_dict(messages.read_legend(String(data=text)), scene().actors["first"])


def test_a_legend_returns_from_its_message() -> None:
    source = read(json.dumps(legend()))
    assert source.to_dict() == legend()


@pytest.mark.parametrize(
    "text",
    ["", "[" * 100_000, '{"a":' * 100_000, "NaN", '{"since": NaN}', "[]", "null", "1" * 10_000, '"\\ud800"'],
    ids=lambda text: text[:12],
)
def test_legends_that_are_no_objects_of_json_are_refused(text: str) -> None:
    with pytest.raises(RosError, match=r"a legend must be|not the JSON of a legend"):
        read(text)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("rest", [[[0.0] * 3] * 3] * 22),
        ("rest", [[[1.0, 0, 0], [0, 1, 0], [0, 0, -1.0]]] * 22),
        ("rest", 10**400),
        ("scale", 0.0),
        ("scale", -1.0),
        ("scale", 1e300),
        ("lift", 1e7),
        ("origin", [1e30, 0.0]),
        ("since", 1e400),
        ("since", "x"),
        ("slack", [-1.0] * 8),
        ("links", [[1e200] * 3] * 8),
        ("own", {"x": 10**6}),
        ("own", {"x": -1}),
        ("joint_names", []),
        ("confidence", 1e400),
    ],
    ids=lambda value: str(value)[:20],
)
def test_legends_with_impossible_values_are_refused(key: str, value: Any) -> None:
    with pytest.raises(HumansimError):
        read(json.dumps(legend() | {key: value}))


#: Replacements for parts of a legend.
EVIL = (
    *(0, -1, 1, 2, 1e-300, 1e5, 1e6, 1e300, 10**400, 0.5, -0.5),
    *(NAN, INF, None, True, "", "x", "1", [], {}, [[]], [0] * 3, [1e300] * 3, {"x": 0}, {"x": [0, 0]}),
)


def mutated(value: Any, rng: random.Random) -> Any:
    """A copy with one part replaced, removed or doubled."""
    if isinstance(value, dict) and value and rng.random() < 0.95:
        key = rng.choice(list(value))
        if rng.random() < 0.1:
            return {name: each for name, each in value.items() if name != key}
        return value | {key: mutated(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.9:
        index = rng.randrange(len(value))
        if rng.random() < 0.05:
            return value[:index] + value[index + 1 :]
        if rng.random() < 0.05:
            return [*value, value[index]]
        return [*value[:index], mutated(value[index], rng), *value[index + 1 :]]
    if isinstance(value, float) and rng.random() < 0.3:
        return value * rng.choice((-1.0, 1e-9, 1e3, 1.01))
    return rng.choice(EVIL)


@pytest.mark.daily("3")
@pytest.mark.parametrize("seed", range(4))
def test_bodies_of_mutated_legends_are_finite(seed: int) -> None:
    rng, actor, whole = random.Random(seed), scene().actors["first"], legend()
    poses: Iterator[JointPoses] = (actor.joint_poses(seconds) for seconds in np.linspace(0, 3, 150))
    accepted = refused = 0
    for pose in poses:
        data = whole
        for _ in range(rng.choice((1, 1, 1, 2, 4))):
            data = mutated(data, rng)
        try:
            source = read(json.dumps(data))
        except HumansimError:
            refused += 1
            continue
        accepted += 1
        retargeter = LiveRetargeter(actor, live=True)
        retargeter.add_legend(source.to_dict())
        try:
            state = retargeter.retarget(pose)
        except HumansimError:
            continue
        for numbers in (state.vertices, state.joints, state.linear, state.angular):
            assert numbers is not None and np.isfinite(numbers).all(), data
    assert accepted > 20 and refused > 20


def test_the_message_of_a_mutated_legend_can_be_published() -> None:
    """Lone surrogates in names are valid JSON, but no text that ROS can carry."""
    source = read(json.dumps(legend() | {"table": "\ud800", "missing": ["\ud800"]}))
    retargeter = LiveRetargeter(scene().actors["first"], live=True)
    retargeter.add_legend(source.to_dict())
    retargeter.retarget(scene().actors["first"].joint_poses(0.0)).joint_names[0].encode()


# --- surfaces


def test_a_mesh_returns_from_its_message_in_both_byte_orders() -> None:
    from rclpy.serialization import serialize_message

    mesh = scene().actors["first"].human.mesh
    data = serialize_message(mesh_message(mesh))
    found = messages.read_mesh(data)
    np.testing.assert_array_equal(found.vertices, mesh.vertices)
    np.testing.assert_array_equal(found.triangles, mesh.triangles)
    few = Mesh(mesh.vertices[:5], np.array([(0, 1, 2, -1), (2, 3, 4, -1)], np.int32))
    data = serialize_message(mesh_message(few))  # an even number of triangles moves the vertices
    numbers = np.frombuffer(data, "u4", 7, 4).byteswap().tobytes()
    gap = data[32:36]
    swapped = (
        b"\0\0\0\0" + numbers + data[32:36][::-1] + np.frombuffer(data, "f8", 15, 36).byteswap().tobytes()
    )
    assert struct.unpack("<I", gap) == (5,)
    np.testing.assert_array_equal(messages.read_mesh(swapped).vertices, few.vertices)
    for length in range(4, len(data)):
        with pytest.raises(RosError):
            messages.read_mesh(data[:length])


@pytest.mark.parametrize(
    ("offset", "value", "message"),
    [
        (4, 0xFFFFFFFF, "ends too early"),
        (8, 0xFFFFFFFF, "vertex outside"),
        (20, 0xFFFFFFFF, "bytes are no mesh"),
        (28, struct.unpack("<Q", struct.pack("<d", NAN))[0], "not finite"),
    ],
)
def test_impossible_meshes_are_refused_at_once(offset: int, value: int, message: str) -> None:
    from rclpy.serialization import serialize_message

    mesh = Mesh(np.eye(3), np.array([(0, 1, 2, -1)], np.int32))
    data = bytearray(serialize_message(mesh_message(mesh)))
    form = "<Q" if offset == 28 else "<I"
    struct.pack_into(form, data, offset, value)
    with pytest.raises(HumansimError, match=message):
        messages.read_mesh(bytes(data))
    with pytest.raises(RosError, match="a mesh of 33554433 bytes; at most 33554432 are read"):
        messages.read_mesh(bytes(1 + (32 << 20)))


def test_a_small_file_of_a_huge_image_is_not_decoded() -> None:
    """Its header says 40000 x 40000 pixels: 4.8 GB."""
    from sensor_msgs.msg import CompressedImage

    whole = compressed_image_message(
        np.zeros((2, 2, 3), np.uint8), "rgb8", messages.ImageCompression("png"), 1, "camera"
    )
    data = bytearray(bytes(whole.data))
    struct.pack_into(">II", data, 16, 40_000, 40_000)
    struct.pack_into(">I", data, 29, zlib.crc32(data[12:29]))
    hostile = CompressedImage(format=whole.format, data=bytes(data))
    with pytest.raises(RosError, match="a compressed image of 40000x40000 pixels; at most 67108864 are read"):
        read_compressed_image(hostile)
