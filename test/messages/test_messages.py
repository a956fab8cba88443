"""Messages have the given content; rosbags, which is independent of rclpy, reads it from their bytes."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera
from humansim_ros.data import messages
from humansim_ros.data.messages.camera_truth import (
    BOX_POINT,
    JOINT_POINT,
    VISIBLE_VERTEX,
    boxes_message,
    joint_view_message,
    overlay_message,
    visible_vertices_message,
)
from humansim_ros.data.messages.cameras import camera_info_message, extrinsics_message, projection_message
from humansim_ros.data.messages.humans import MarkerBuilder, joints_message, motion_message, vertices_message
from humansim_ros.data.messages.images import image_message
from humansim_ros.data.messages.legends import instance_legend, joints_legend, material_legend, part_legend
from humansim_ros.data.messages.points import point_cloud
from humansim_ros.errors import RosError
from humansim_ros.scene import Scene
from humansim_ros.scene.truth.camera_truth import BodyBox, JointView

pytest.importorskip("rclpy")
STAMP = 1_700_000_000_123_456_789


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.load()


@pytest.fixture(scope="module")
def read_outside() -> Any:
    """Deserialiser of CDR with the message definitions of rosbags."""
    rosbags_typesys = pytest.importorskip("rosbags.typesys")
    from rclpy.serialization import serialize_message

    store = rosbags_typesys.get_typestore(rosbags_typesys.Stores.ROS2_JAZZY)

    def read(message: Any) -> Any:
        kind = f"{type(message).__module__.split('.')[0]}/msg/{type(message).__name__}"
        return store.deserialize_cdr(bytes(serialize_message(message)), kind)

    return read


def test_stamps_are_kept_to_the_nanosecond() -> None:
    stamp = messages.to_time(STAMP)
    assert (stamp.sec, stamp.nanosec) == (1_700_000_000, 123_456_789)
    assert messages.to_nanoseconds(stamp) == STAMP


def test_joints_arrive_as_they_were_sent(scene: Scene, read_outside: Any) -> None:
    state = scene.actors["walker"].at(0.7)
    sent = joints_message(state, STAMP)
    outside = read_outside(sent)
    assert outside.header.frame_id == "map"
    assert outside.joint_names == list(state.joint_names)
    for transform, twist, joint, linear, angular in zip(
        outside.transforms, outside.twist, state.joints, state.linear, state.angular, strict=True
    ):
        t, q = transform.translation, transform.rotation
        assert np.allclose([t.x, t.y, t.z], joint[:3, 3], atol=0)
        assert np.allclose(Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), joint[:3, :3], atol=1e-12)
        assert np.allclose([twist.linear.x, twist.linear.y, twist.linear.z], linear, atol=0)
        assert np.allclose([twist.angular.x, twist.angular.y, twist.angular.z], angular, atol=0)
    back = messages.read_joints(sent)
    assert np.array_equal(back.positions[0], state.positions)


def test_a_pose_that_is_not_finite_is_refused(scene: Scene) -> None:
    message = motion_message(scene.actors["walker"].joint_poses(0.0), STAMP)
    message.transforms[3].translation.y = float("nan")
    with pytest.raises(RosError):
        messages.read_joints(message)
    message.transforms[3].translation.y = 0.0
    message.joint_names.append("one_too_many")
    with pytest.raises(RosError):
        messages.read_joints(message)


def test_vertices_are_x_y_z_float32_in_mesh_order(scene: Scene, read_outside: Any) -> None:
    state = scene.actors["walker"].at(0.3)
    message = vertices_message(state.vertices, STAMP)
    outside = read_outside(message)
    assert (outside.height, outside.width, outside.point_step) == (1, len(state.vertices), 12)
    assert [(f.name, f.offset, f.datatype, f.count) for f in outside.fields] == [
        ("x", 0, 7, 1),
        ("y", 4, 7, 1),
        ("z", 8, 7, 1),
    ]
    assert np.array_equal(outside.data.view("<f4").reshape(-1, 3), state.vertices)
    assert np.array_equal(messages.read_vertices(message), state.vertices)


def test_points_with_more_fields_or_the_wrong_layout() -> None:
    vertices = np.arange(12, dtype=np.float32).reshape(4, 3)
    message = vertices_message(vertices, STAMP)
    wide = np.zeros((4, 5), "<f4")
    wide[:, :3] = vertices
    message.point_step, message.row_step = 20, 80
    message._data = wide.reshape(-1).view(np.uint8)
    assert np.array_equal(messages.read_vertices(message), vertices)
    message.fields[0].name = "intensity"
    with pytest.raises(RosError):
        messages.read_vertices(message)


@pytest.mark.parametrize(
    ("encoding", "array"),
    [
        ("rgb8", np.arange(5 * 7 * 3, dtype=np.uint8).reshape(5, 7, 3)),
        ("32FC1", np.linspace(0, 9, 35, dtype=np.float32).reshape(5, 7)),
        ("mono16", (np.arange(35, dtype=np.uint16) * 1000).reshape(5, 7)),
        ("mono8", np.arange(35, dtype=np.uint8).reshape(5, 7)),
    ],
)
def test_images_keep_their_rows_and_numbers(encoding: str, array: np.ndarray, read_outside: Any) -> None:
    outside = read_outside(image_message(array, encoding, STAMP, "cam_optical_frame"))
    assert (outside.height, outside.width, outside.encoding) == (5, 7, encoding)
    assert outside.is_bigendian == 0
    assert outside.step == 7 * array.itemsize * (3 if array.ndim == 3 else 1)
    assert np.array_equal(outside.data.view(array.dtype).reshape(array.shape), array)
    assert outside.header.frame_id == "cam_optical_frame"


def test_camera_info_is_that_of_an_undistorted_driver(read_outside: Any) -> None:
    camera = Camera((320, 240), np.array([[300, 0, 150], [0, 310, 120], [0, 0, 1.0]]), np.eye(3), np.zeros(3))
    info = read_outside(camera_info_message(camera, STAMP, "cam_optical_frame"))
    assert (info.width, info.height, info.distortion_model) == (320, 240, "plumb_bob")
    assert np.array_equal(info.k, [300, 0, 150, 0, 310, 120, 0, 0, 1])
    assert np.array_equal(info.d, np.zeros(5))
    assert np.array_equal(info.r, np.eye(3).ravel())
    assert np.array_equal(info.p, [300, 0, 150, 0, 0, 310, 120, 0, 0, 0, 1, 0])


def test_extrinsics_are_the_pose_of_the_optical_frame_as_in_tf(read_outside: Any) -> None:
    camera = Camera.look_at([2.0, -1.0, 1.5], [0.0, 0.0, 1.0])
    message = read_outside(extrinsics_message(camera, STAMP, "cam_optical_frame"))
    assert (message.header.frame_id, message.child_frame_id) == ("map", "cam_optical_frame")
    t, q = message.transform.translation, message.transform.rotation
    assert np.allclose([t.x, t.y, t.z], [2.0, -1.0, 1.5], atol=1e-12)
    # the optical axis, rotated to the world, points to the target
    axis = Rotation.from_quat([q.x, q.y, q.z, q.w]).apply([0, 0, 1])
    assert np.allclose(axis, np.array([-2.0, 1.0, -0.5]) / np.sqrt(5.25), atol=1e-12)


def test_projection_is_the_camera_matrix_row_by_row(read_outside: Any) -> None:
    camera = Camera.look_at([2.0, -1.0, 1.5], [0.0, 0.0, 1.0])
    message = read_outside(projection_message(camera))
    assert [d.size for d in message.layout.dim] == [3, 4]
    image = message.data.reshape(3, 4) @ [0.0, 0.0, 1.0, 1.0]
    assert np.allclose(image[:2] / image[2], [319.5, 239.5], atol=1e-9)


def test_joint_view_has_the_layout_of_its_fields(read_outside: Any) -> None:
    view = JointView(
        optical=np.array([[0.1, 0.2, 3.0], [0.0, 0.0, -1.0]]),
        pixels=np.array([[12.5, 100.25], [np.nan, np.nan]]),
        visible=np.array([1, 0], np.uint8),
        occluder=np.array([2, 0], np.uint8),
        by=np.array([300, 0], np.uint16),
        behind=np.array([0.25, np.nan], np.float32),
    )
    outside = read_outside(joint_view_message([(1, view), (7, view)], STAMP, "cam_optical_frame"))
    assert (outside.width, outside.point_step, outside.is_dense) == (4, 32, False)
    read = columns_of(outside)
    assert np.allclose(read["z"], [3.0, -1.0, 3.0, -1.0])
    assert np.allclose(read["u"], [12.5, np.nan, 12.5, np.nan], equal_nan=True)
    assert np.allclose(read["v"], [100.25, np.nan, 100.25, np.nan], equal_nan=True)
    assert read["visible"].tolist() == [1, 0, 1, 0]
    assert read["occluder"].tolist() == [2, 0, 2, 0]
    assert read["by"].tolist() == [300, 0, 300, 0]
    assert np.array_equal(read["behind"], np.float32([0.25, np.nan] * 2), equal_nan=True)
    assert read["human"].tolist() == [1, 1, 7, 7]
    assert read["joint"].tolist() == [0, 1, 0, 1]


def test_the_overlay_has_visible_and_hidden_joints_inside_the_image(read_outside: Any) -> None:
    nothing = np.zeros(4, np.uint8)
    view = JointView(
        optical=np.zeros((4, 3)),
        pixels=np.array([[0.0, 0.0], [12.5, 100.25], [-7.0, 3.0], [np.nan, np.nan]]),
        visible=np.array([2, 1, 0, 0], np.uint8),
        occluder=nothing,
        by=nothing.astype(np.uint16),
        behind=nothing.astype(np.float32),
    )
    other = JointView(view.optical, view.pixels + 1, view.visible, view.occluder, view.by, view.behind)
    outside = read_outside(overlay_message([view, other], 4.0, STAMP, "cam_optical_frame"))
    assert outside.header.frame_id == "cam_optical_frame"
    assert (outside.header.stamp.sec, outside.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    assert (outside.type, outside.action, outside.scale) == (outside.POINTS, outside.ADD, 4.0)
    # the centre of the top-left pixel is (0, 0), as in <camera>/joints
    assert [(p.x, p.y) for p in outside.points] == [(0, 0), (12.5, 100.25), (1, 1), (13.5, 101.25)]
    colors = [(round(c.r, 2), round(c.g, 2), round(c.b, 2), c.a) for c in outside.outline_colors]
    green, orange = (0.24, 0.9, 0.35, 1), (1, 0.59, 0.16, 1)
    assert colors == [green, orange, green, orange]
    empty = read_outside(overlay_message([], 4.0, STAMP, "cam_optical_frame"))
    assert not empty.points and empty.type == outside.POINTS  # it takes the last one away


def columns_of(cloud: Any) -> dict[str, np.ndarray]:
    """Fields of a PointCloud2, read from its bytes."""
    kinds = {7: "<f4", 6: "<u4", 4: "<u2", 2: "u1"}
    rows = cloud.data.reshape(cloud.width, cloud.point_step)
    return {
        f.name: np.ascontiguousarray(rows[:, f.offset : f.offset + np.dtype(kinds[f.datatype]).itemsize])
        .view(kinds[f.datatype])
        .ravel()
        for f in cloud.fields
    }


def test_boxes_have_the_layout_of_their_fields(read_outside: Any) -> None:
    one = BodyBox(np.array([9.5, -0.5, 70.5, 100.5]), np.array([-20.25, -30, 71, 101.5]), 0.25, 0.5, 4321)
    none = BodyBox(np.full(4, np.nan), np.full(4, np.nan), 1.0, np.nan, 0)
    message = boxes_message([(3, one), (700, none)], STAMP, "cam_optical_frame")
    outside = read_outside(message)
    assert (outside.width, outside.point_step, outside.is_dense) == (2, 48, False)
    read = columns_of(outside)
    sides = ["left", "top", "right", "bottom"]
    assert [read[side][0] for side in sides] == one.visible.tolist()
    assert [read[f"whole_{side}"][0] for side in sides] == one.whole.tolist()
    assert np.isnan([read[prefix + side][1] for prefix in ("", "whole_") for side in sides]).all()
    assert read["instance"].tolist() == [3, 700]
    assert read["pixels"].tolist() == [4321, 0]
    assert read["truncation"].tolist() == [0.25, 1.0]
    assert np.array_equal(read["visible_fraction"], [0.5, np.nan], equal_nan=True)
    assert messages.read_boxes(message).tobytes() == bytes(outside.data)
    assert boxes_message([(3, one)], STAMP, "cam_optical_frame").is_dense


def test_visible_vertices_are_listed_by_human(read_outside: Any) -> None:
    first, second = np.zeros(70_000, bool), np.zeros(5, bool)
    first[[0, 69_999]], second[2] = True, True
    message = visible_vertices_message([(1, first), (9, second)], STAMP, "cam_optical_frame")
    read = columns_of(read_outside(message))
    assert read["vertex"].tolist() == [0, 69_999, 2]
    assert read["instance"].tolist() == [1, 1, 9]
    assert messages.read_visible_vertices(message)["vertex"].tolist() == [0, 69_999, 2]
    nobody = visible_vertices_message([(1, np.zeros(5, bool))], STAMP, "cam_optical_frame")
    assert (nobody.width, len(messages.read_visible_vertices(nobody))) == (0, 0)


def test_joints_recorded_with_fewer_fields_are_read() -> None:
    kinds = {"x": "<f4", "y": "<f4", "z": "<f4", "u": "<f4", "v": "<f4", "visible": "u1"}
    old = np.zeros(3, np.dtype([*kinds.items(), ("human", "<u2"), ("joint", "<u2")], align=True))
    old["u"], old["joint"] = [1, 2, 3], [0, 1, 2]
    message = point_cloud(old, messages.header(STAMP, "cam_optical_frame"))
    read = messages.read_joint_view(message)
    assert read["u"].tolist() == [1, 2, 3]
    assert read["joint"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("fault", ["field", "step", "bytes", "offset", "great offset", "endian", "twice"])
def test_points_with_an_inconsistent_layout_are_refused(fault: str) -> None:
    box = BodyBox(np.zeros(4), np.zeros(4), 0.0, 1.0, 1)
    message = boxes_message([(1, box)], STAMP, "cam_optical_frame")
    if fault == "field":
        message.fields = message.fields[:-1]
    elif fault == "step":
        message.point_step = 0
    elif fault == "bytes":
        message.width = 2
    elif fault == "offset":
        message.fields[0].offset = 1000
    elif fault == "great offset":  # NumPy would add its size beyond the largest integer
        message.fields[0].offset = 2**31 - 2
    elif fault == "endian":
        message.is_bigendian = True
    else:
        message.fields[0].name = "top"
    with pytest.raises(RosError):
        messages.read_boxes(message)


def test_legends_are_json_that_name_every_number(scene: Scene) -> None:
    skeleton = scene.actors["walker"].human.skeleton
    parts = json.loads(part_legend(skeleton).data)
    assert parts["0"] == "background"
    assert [parts[str(i + 1)] for i in range(57)] == list(skeleton.names)
    assert json.loads(instance_legend({"walker": 1}).data) == {"0": "background", "1": "walker"}
    material = json.loads(material_legend().data)
    assert [material[str(n)] for n in (0, 1, 2, 4, 5)] == ["background", "unknown", "skin", "hair", "top"]
    joints = json.loads(joints_legend({"walker": (1, skeleton.joint_names)}).data)
    assert joints["human"] == {"1": "walker"}
    assert joints["joint"]["walker"] == list(skeleton.joint_names)
    assert joints["visible"] == {"0": "outside", "1": "occluded", "2": "visible"}
    assert joints["occluder"] == {"0": "nothing", "1": "self", "2": "person", "3": "thing"}


def test_markers_are_few_enough_for_a_viewer_and_lie_on_the_body(scene: Scene) -> None:
    actor = scene.actors["walker"]
    state = actor.at(0.0)
    array = MarkerBuilder(actor.human).build("walker", 1, state, STAMP)
    by_kind = {marker.ns.split("/")[1]: marker for marker in array.markers}
    assert set(by_kind) == {"skeleton", "joints", "skin"}
    skin = np.array([(p.x, p.y, p.z) for p in by_kind["skin"].points])
    assert len(skin) % 3 == 0
    assert 500 < len(skin) // 3 < 8000
    # a coarse skin is as large as the fine one
    assert np.abs(skin.min(0) - state.vertices.min(0)).max() < 0.05
    assert np.abs(skin.max(0) - state.vertices.max(0)).max() < 0.05
    assert len(by_kind["skeleton"].points) == 2 * 57


@pytest.mark.parametrize(
    "dtype", [JOINT_POINT, BOX_POINT, VISIBLE_VERTEX], ids=["joints", "boxes", "vertices"]
)
def test_the_documented_lines_decode_a_point_cloud_without_sensor_msgs_py(dtype: np.dtype[Any]) -> None:
    text = (ROOT / "docs" / "topics.md").read_text()
    (code,) = (
        block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "def points" in block
    )
    space: dict[str, Any] = {}
    exec(code, space)
    sent = np.zeros(3, dtype)
    for number, name in enumerate(dtype.names or ()):
        sent[name] = np.arange(3) + 7 * number
    found = space["points"](point_cloud(sent, messages.header(5, "left")))
    assert found.dtype.names == dtype.names and len(found) == 3
    for name in dtype.names or ():
        np.testing.assert_array_equal(found[name], sent[name])
