"""Messages of laser scanners: points in the layouts of drivers, LaserScan, and ground truth."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.scanner import Layout, Rays
from humansim_ros.data.messages.headers import header
from humansim_ros.data.messages.points import point_cloud, read_points
from humansim_ros.data.messages.types import LaserScan, PointCloud2
from humansim_ros.scene.features import SceneScanner, Sweep

#: Intensity of a white surface that the ray hits at a right angle, in the layouts of drivers.
WHITE = 255.0


def _packed(*fields: tuple[str, str]) -> np.dtype[Any]:
    return np.dtype([(name, f"<{kind}") for name, kind in fields])


_XYZ = (("x", "f4"), ("y", "f4"), ("z", "f4"))
#: One point of ``<scanner>/points`` by layout, as the ROS 2 driver of the maker defines it:
#: velodyne_pointcloud (PointXYZIRT), ouster_ros (Point), livox_ros_driver2 (PointXYZRTLT), nebula and
#: Autoware (PointXYZIRCAEDT).
SCANNER_POINTS: dict[Layout, np.dtype[Any]] = {
    "velodyne": _packed(*_XYZ, ("intensity", "f4"), ("ring", "u2"), ("time", "f4")),
    "ouster": np.dtype(
        {
            "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
            "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "<u2", "<u2", "<u4"],
            "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
            "itemsize": 48,
        }
    ),
    "livox": _packed(*_XYZ, ("intensity", "f4"), ("tag", "u1"), ("line", "u1"), ("timestamp", "f8")),
    "autoware": _packed(
        *_XYZ,
        ("intensity", "u1"),
        ("return_type", "u1"),
        ("channel", "u2"),
        ("azimuth", "f4"),
        ("elevation", "f4"),
        ("distance", "f4"),
        ("time_stamp", "u4"),
    ),
    "xyzi": _packed(*_XYZ, ("intensity", "f4")),
}
#: One point of ``<scanner>/truth/points``: the true point and distance, and the labels of the surface.
SCANNER_TRUTH = _packed(
    *_XYZ, ("range", "f4"), ("time", "f4"), ("instance", "u2"), ("part", "u1"), ("ring", "u1")
)


def scanner_frame(scanner: str) -> str:
    """Name of the coordinate frame of a scanner: x forward, y left, z up (REP-103)."""
    return f"{scanner}_frame"


def points_message(sweep: Sweep, layout: Layout, frame: str) -> PointCloud2:
    """Build ``<scanner>/points``. Layout ``ouster`` has rows (rings) and columns, with NaN where nothing is
    measured.

    Args:
        sweep: Measurements of one turn of the scanner.
        layout: Name of the layout.
        frame: Name of the scanner's frame.
    """
    returns, rays = sweep.returns, _numbered(sweep, layout)
    points = np.zeros(len(returns.rays), SCANNER_POINTS[layout])
    _put(points, "xyz", sweep.points)
    names, time = points.dtype.names or (), sweep.times + (sweep.start - sweep.stamp)
    rings, white = rays.rings[returns.rays], WHITE * returns.intensities
    values: dict[str, Any] = {
        "ring": lambda: rings,
        "channel": lambda: rings,
        "line": lambda: rings,
        "time": lambda: time * 1e-9,
        "t": lambda: np.maximum(time, 0),
        "time_stamp": lambda: np.maximum(time, 0),
        "timestamp": lambda: (sweep.start + sweep.times).astype(float),
        "range": lambda: np.rint(returns.measured * 1e3),
        "reflectivity": lambda: np.minimum(white, 65535),
        "return_type": lambda: returns.kinds,
        "distance": lambda: returns.measured,
        "azimuth": lambda: np.arctan2(points["y"], points["x"]),
        "elevation": lambda: np.arctan2(points["z"], np.hypot(points["x"], points["y"])),
    }
    for name in names:
        if name in values:
            points[name] = values[name]()
    points["intensity"] = white if points["intensity"].dtype.kind == "f" else np.minimum(np.rint(white), 255)
    after = np.maximum(rays.times + (sweep.start - sweep.stamp), 0)
    return _cloud(sweep, layout, frame, points, ring=rays.rings, t=after)


def _numbered(sweep: Sweep, layout: Layout) -> Rays:
    """Rays of a sweep, with the ring numbers of a layout. In ``ouster`` ring 0 is the highest row."""
    return sweep.rays.from_top() if layout == "ouster" else sweep.rays


def _cloud(sweep: Sweep, layout: Layout, frame: str, points: NDArray[Any], **every: Any) -> PointCloud2:
    """Build a cloud. In a LaserScan, and in layout ``ouster`` with rings and columns, each ray has a point.
    The axes are NaN where nothing is measured.

    Args:
        sweep: Measurements of one turn of the scanner.
        layout: Name of the layout.
        frame: Name of the scanner's frame.
        points: Structured array with a point for each return.
        every: By field: values for all rays, for those without a return.
    """
    head, rays, measured = header(sweep.stamp, frame), _numbered(sweep, layout), sweep.returns.rays
    # two returns of a ray have no place in rings and columns
    grid = rays.grid if layout == "ouster" and (np.diff(measured) > 0).all() else None
    if layout != "scan" and grid is None:
        return point_cloud(points, head)
    table = np.zeros(len(rays), points.dtype)
    for name, values in {**dict.fromkeys("xyz", np.nan), **every}.items():
        table[name] = values
    table[measured] = points
    if grid is not None:
        rows, table = table, np.zeros(grid, points.dtype)
        table[rays.rings, np.arange(len(rays)) // grid[0]] = rows
    message = point_cloud(table, head)
    message.is_dense = False
    return message


def _put(points: NDArray[Any], names: str, values: NDArray[Any]) -> None:
    for number, name in enumerate(names):
        points[name] = values[:, number]


def scan_message(sweep: Sweep, scanner: SceneScanner, frame: str) -> LaserScan:
    """Build ``<scanner>/scan``. Where no surface is within range, the value is infinite (REP-117)."""
    rays, returns = sweep.rays, sweep.returns
    assert rays.azimuths is not None
    first, step = rays.azimuths
    low, high = scanner.measuring.range
    ranges, intensities = np.full(len(rays), np.inf, np.float32), np.zeros(len(rays), np.float32)
    ranges[returns.rays], intensities[returns.rays] = returns.measured, WHITE * returns.intensities
    message = LaserScan(header=header(sweep.stamp, frame))
    message.angle_min, message.angle_increment = first, step
    message.angle_max = first + step * (len(rays) - 1)
    message.time_increment = float(rays.times[1] * 1e-9) if len(rays) > 1 else 0.0
    message.scan_time = (sweep.end - sweep.start) * 1e-9
    message.range_min, message.range_max = float(low), float(high)
    message.ranges, message.intensities = ranges.tolist(), intensities.tolist()
    return message


def scanner_truth_message(sweep: Sweep, layout: Layout, frame: str) -> PointCloud2:
    """Build ``<scanner>/truth/points``: as many points as the message of the layout, in the same order. In a
    LaserScan and in layout ``ouster``, a ray without a return has a point of NaN."""
    returns, rays = sweep.returns, _numbered(sweep, layout)
    points = np.zeros(len(returns.rays), SCANNER_TRUTH)
    _put(points, "xyz", sweep.true_points)
    points["range"], points["time"] = returns.ranges, (sweep.times + (sweep.start - sweep.stamp)) * 1e-9
    points["instance"], points["part"] = sweep.instances, sweep.parts
    points["ring"] = np.minimum(rays.rings[returns.rays], 255)
    every = {
        "range": np.nan,
        "time": (rays.times + (sweep.start - sweep.stamp)) * 1e-9,
        "ring": np.minimum(rays.rings, 255),
    }
    return _cloud(sweep, layout, frame, points, **every)


def read_scanner_truth(message: PointCloud2) -> NDArray[Any]:
    """Read ``<scanner>/truth/points`` as a structured array (P,) of :data:`SCANNER_TRUTH`. Raises RosError
    for another layout."""
    return read_points(message, SCANNER_TRUTH.names or ())
