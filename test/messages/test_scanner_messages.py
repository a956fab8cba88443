"""Messages of laser scanners: fields byte by byte as drivers have them, values against the sweep."""

from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from humansim_ros.cameras import Trajectory
from humansim_ros.cameras.scanner.models import Layout, Measuring, Pattern, Rays, Returns, spinning
from humansim_ros.data import messages
from humansim_ros.data.messages.points import point_rows
from humansim_ros.data.messages.scanners import points_message, scan_message, scanner_truth_message
from humansim_ros.scene.features.scanners.feature import SceneScanner, Sweep
from humansim_ros.types import Array

#: Name, offset and datatype (sensor_msgs/PointField) of each field, and bytes of a point.
FIELDS: dict[Layout, tuple[str, int]] = {
    # velodyne_pointcloud, PointXYZIRT
    "velodyne": ("x 0 7, y 4 7, z 8 7, intensity 12 7, ring 16 4, time 18 7", 22),
    # ouster_ros, Point
    "ouster": (
        "x 0 7, y 4 7, z 8 7, intensity 16 7, t 20 6, reflectivity 24 4, ring 26 4, ambient 28 4, range 32 6",
        48,
    ),
    # livox_ros_driver2, LivoxPointXyzrtlt
    "livox": ("x 0 7, y 4 7, z 8 7, intensity 12 7, tag 16 2, line 17 2, timestamp 18 8", 26),
    # autoware_point_types, PointXYZIRCAEDT
    "autoware": (
        (
            "x 0 7, y 4 7, z 8 7, intensity 12 2, return_type 13 2, channel 14 4, azimuth 16 7, "
            "elevation 20 7, distance 24 7, time_stamp 28 6"
        ),
        32,
    ),
    "xyzi": ("x 0 7, y 4 7, z 8 7, intensity 12 7", 16),
}
START, PERIOD = 5_000_000_000, 100_000_000


def sweep(rays: Rays, stamp: int = START) -> Sweep:
    """Every second ray has a return."""
    chosen = np.arange(0, len(rays), 2)
    count = len(chosen)
    ranges: Array = 2 + 0.01 * np.arange(count, dtype=float)
    returns = Returns(
        chosen,
        np.full(count, 1, np.uint8),
        ranges,
        ranges + 0.002,
        np.linspace(0.1, 0.9, count),
        np.zeros(count, np.int32),
        np.zeros(count, np.int32),
    )
    labels = np.arange(count)
    pose = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
    return Sweep(
        4,
        START,
        START + PERIOD,
        stamp,
        rays,
        returns,
        labels.astype(np.uint16),
        labels.astype(np.uint8),
        *pose,
    )


def pattern() -> Pattern:
    return spinning(10.0, (-10.0, 5.0, 0.0), 8, firing=1e-3, channel=1e-4)


@pytest.mark.parametrize("layout", FIELDS)
def test_fields_are_those_of_the_driver(layout: Layout) -> None:
    message = points_message(sweep(pattern().rays(0)), layout, "lidar_frame")
    text = ", ".join(f"{field.name} {field.offset} {field.datatype}" for field in message.fields)
    assert (text, message.point_step) == FIELDS[layout]
    assert all(field.count == 1 for field in message.fields) and not message.is_bigendian
    assert len(message.data) == message.width * message.height * message.point_step
    assert message.row_step == message.width * message.point_step
    assert message.header.frame_id == "lidar_frame"


@pytest.mark.parametrize("layout", [each for each in FIELDS if each != "ouster"])
def test_points_are_measured_and_in_firing_order(layout: Layout) -> None:
    seen = sweep(pattern().rays(0))
    rows = point_rows(points_message(seen, layout, "lidar_frame"))
    position = np.stack([rows[axis] for axis in "xyz"], axis=1)
    directions = seen.rays.directions[::2]
    np.testing.assert_allclose(position, directions * (2.002 + 0.01 * np.arange(12))[:, None], rtol=1e-6)
    scale = rows["intensity"].astype(float) / 255
    np.testing.assert_allclose(scale, np.linspace(0.1, 0.9, 12), atol=0.003)


def test_bytes_of_a_velodyne_point() -> None:
    seen = sweep(pattern().rays(0), START + PERIOD)
    message = points_message(seen, "velodyne", "lidar_frame")
    x, y, z, intensity, ring, time = struct.unpack_from("<ffffHf", bytes(message.data), 22)
    # the third laser of the first column: elevation 0, 0.2 ms after the start, 0.72 degrees on
    np.testing.assert_allclose((np.hypot(x, y), z), (2.012, 0), atol=1e-6)
    assert np.degrees(np.arctan2(y, x)) == pytest.approx(180 - 0.72, abs=1e-4)
    assert (ring, time) == (1, pytest.approx(-0.0998, abs=1e-6))
    assert intensity == pytest.approx(255 * (0.1 + 0.8 / 11), rel=1e-5)
    assert message.header.stamp.nanosec == 100_000_000


def test_times_of_the_layouts_are_the_same_instants() -> None:
    seen = sweep(pattern().rays(0))
    after = seen.rays.times[::2]

    def rows(layout: Layout) -> Any:
        return point_rows(points_message(seen, layout, "f"))

    np.testing.assert_allclose(rows("velodyne")["time"], after * 1e-9, rtol=1e-6)
    np.testing.assert_array_equal(rows("autoware")["time_stamp"], after)
    np.testing.assert_allclose(rows("livox")["timestamp"], START + after, rtol=0, atol=1)
    table = rows("ouster")
    np.testing.assert_array_equal(np.sort(table["t"][np.isfinite(table["x"])]), after)


def test_angles_and_distance_of_autoware_are_those_of_the_point() -> None:
    rows = point_rows(points_message(sweep(pattern().rays(0)), "autoware", "f"))
    flat = rows["distance"] * np.cos(rows["elevation"])
    np.testing.assert_allclose(flat * np.cos(rows["azimuth"]), rows["x"], atol=1e-5)
    np.testing.assert_allclose(flat * np.sin(rows["azimuth"]), rows["y"], atol=1e-5)
    np.testing.assert_allclose(rows["distance"] * np.sin(rows["elevation"]), rows["z"], atol=1e-5)


def test_an_ouster_cloud_is_a_table_from_the_highest_ring() -> None:
    rays = pattern().rays(0)
    message = points_message(sweep(rays), "ouster", "f")
    assert (message.height, message.width, message.is_dense) == (3, 8, False)
    table = point_rows(message).reshape(3, 8)
    elevation = np.degrees(np.arctan2(table["z"], np.hypot(table["x"], table["y"])))
    for row, expected in enumerate((5, 0, -10)):
        np.testing.assert_allclose(elevation[row][np.isfinite(elevation[row])], expected, atol=1e-4)
    assert np.isfinite(table["x"]).sum() == 12
    assert (table["ring"] == np.arange(3)[:, None]).all()
    truth = point_rows(scanner_truth_message(sweep(rays), "ouster", "f")).reshape(3, 8)
    np.testing.assert_array_equal(truth["ring"], table["ring"])
    np.testing.assert_array_equal(np.isfinite(truth["x"]), np.isfinite(table["x"]))
    np.testing.assert_allclose(
        truth["range"], np.hypot(np.hypot(truth["x"], truth["y"]), truth["z"]), rtol=1e-6
    )


@pytest.mark.parametrize("layout", ["velodyne", "ouster", "autoware"])
def test_points_and_truth_count_rings_alike(layout: Layout) -> None:
    """Also in the layout of Ouster with several returns of a ray, which are no table."""
    seen = sweep(pattern().rays(0))
    twice = np.repeat(np.arange(12), 2)
    seen = replace(
        seen, returns=seen.returns.take(twice), instances=seen.instances[twice], parts=seen.parts[twice]
    )
    rows, truth = (point_rows(build(seen, layout, "f")) for build in (points_message, scanner_truth_message))
    rings = rows["channel" if layout == "autoware" else "ring"]
    np.testing.assert_array_equal(rings, truth["ring"])
    elevation = np.degrees(np.arctan2(rows["z"], np.hypot(rows["x"], rows["y"])))
    of_ring = np.array([5, 0, -10] if layout == "ouster" else [-10, 0, 5])
    np.testing.assert_allclose(elevation, of_ring[rings], atol=1e-4)


def test_truth_has_labels_and_distances_without_noise() -> None:
    seen = sweep(pattern().rays(0))
    rows = messages.read_scanner_truth(scanner_truth_message(seen, "velodyne", "f"))
    np.testing.assert_array_equal(rows["instance"], np.arange(12))
    np.testing.assert_array_equal(rows["part"], np.arange(12))
    np.testing.assert_allclose(rows["range"], 2 + 0.01 * np.arange(12), rtol=1e-6)


def test_a_laser_scan_has_a_range_for_each_ray() -> None:
    plane = spinning(40.0, (0.0,), 21, (-90.0, 90.0))
    identity = Trajectory(np.zeros(1), np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0, 1.0]]))
    scanner = SceneScanner("flat", plane, Measuring((0.1, 30.0)), "scan", "start", identity)
    seen = sweep(plane.rays(0))
    message = scan_message(seen, scanner, "flat_frame")
    assert (message.angle_min, message.angle_max) == pytest.approx((-np.pi / 2, np.pi / 2))
    assert message.angle_increment == pytest.approx(np.radians(9))
    assert message.time_increment == pytest.approx(0.025 * 9 / 360)
    assert (message.range_min, message.range_max) == pytest.approx((0.1, 30))
    ranges = np.array(message.ranges)
    assert len(ranges) == len(message.intensities) == 21
    np.testing.assert_allclose(ranges[::2], 2.002 + 0.01 * np.arange(11), rtol=1e-6)
    assert np.isinf(ranges[1::2]).all()
    truth = messages.read_scanner_truth(scanner_truth_message(seen, "scan", "flat_frame"))
    np.testing.assert_array_equal(np.isnan(truth["range"]), np.isinf(ranges))
