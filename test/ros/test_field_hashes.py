"""tools/field_hashes.py sees every value, and only values."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

pytest.importorskip("rclpy")
sys.path.append(str(ROOT / "tools"))

import field_hashes

from humansim_ros.data import messages
from humansim_ros.data.messages.camera_truth import boxes_message
from humansim_ros.data.messages.cameras import camera_info_message, projection_message
from humansim_ros.data.messages.headers import scene_time_message
from humansim_ros.data.messages.images import image_message
from humansim_ros.data.messages.legends import instance_legend
from humansim_ros.scene import BodyBox


def boxes(stamp: int = 5, pixels: int = 40) -> Any:
    box = BodyBox(np.arange(4.0), np.arange(4.0) + 1, 0.1, 0.5, pixels)
    return boxes_message([(1, box), (2, box)], stamp, "left_optical_frame")


def image(value: int = 0, encoding: str = "mono8") -> Any:
    return image_message(np.array([[1, 2], [3, value]], np.uint8), encoding, 5, "left_optical_frame")


def test_stamps_and_padding_are_no_values() -> None:
    padded = boxes(stamp=9)
    data = np.array(padded.data, np.uint8).reshape(2, padded.point_step)
    used = sum(4 if field.datatype in (6, 7) else 2 if field.datatype == 4 else 1 for field in padded.fields)
    assert used < padded.point_step
    data[:, used:] = 77
    padded._data = data.ravel()
    assert field_hashes.field_hash(padded) == field_hashes.field_hash(boxes())


def test_every_other_value_counts() -> None:
    different = [
        boxes(),
        boxes(pixels=41),
        image(),
        image(1),
        image(encoding="8UC1"),
        messages.header(5, "a"),
        messages.header(5, "b"),
        instance_legend({"anna": 1}),
        instance_legend({"anna": 2}),
    ]
    assert len({field_hashes.field_hash(message) for message in different}) == len(different)


def test_messages_of_rclpy_and_of_rosbags_have_one_hash() -> None:
    from rclpy.serialization import serialize_message
    from rosbags.typesys import Stores, get_typestore

    from humansim_ros.cameras import Camera

    camera = Camera.look_at((3, 0, 1), (0, 0, 1), (64, 48))
    store = get_typestore(Stores.ROS2_JAZZY)
    for kind, message in (
        ("sensor_msgs/msg/PointCloud2", boxes()),
        ("sensor_msgs/msg/Image", image()),
        ("sensor_msgs/msg/CameraInfo", camera_info_message(camera, 5, "left_optical_frame")),
        ("std_msgs/msg/Float64MultiArray", projection_message(camera)),
        ("sensor_msgs/msg/TimeReference", scene_time_message(7, 5)),
    ):
        other = store.deserialize_cdr(serialize_message(message), kind)
        assert field_hashes.field_hash(other) == field_hashes.field_hash(message), kind


def test_frames_are_matched_by_scene_time() -> None:
    def run(start: int, value: int) -> field_hashes.Hashes:
        sent = []
        for number in range(2):
            head = messages.header(start + number, "map")
            one = image_message(np.full((2, 2), value * number, np.uint8), "mono8", start + number, "a")
            sent += [("/n/scene_time", scene_time_message(number, start + number))]
            sent += [("/n/humans/anna/frame", head), ("/n/left/image_raw", one)]
        return field_hashes.hashes(sent, "n")

    assert field_hashes.differences(run(100, 3), run(500, 3)) == []
    assert field_hashes.differences(run(100, 3), run(500, 4)) == ["/left/image_raw at 0.000000001 s"]
