"""Scanners by name: pattern, limits and noise as their manufacturers state them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from humansim_ros.scanner.pattern import Pattern, oscillating, raster, rosette, spinning

#: Fields of the points, as drivers name and order them; ``scan`` is a sensor_msgs/LaserScan.
Layout = Literal["velodyne", "ouster", "livox", "autoware", "xyzi", "scan"]
#: What the stamp of a message means.
StampOf = Literal["start", "end"]


@dataclass(frozen=True)
class ScannerModel:
    """One scanner.

    Attributes:
        title: Name of the product.
        source: Where the figures come from, then the file of its driver that numbers its rings.
        rate: Sweeps per second.
        pattern: Makes the pattern at a rate.
        range: Least and greatest distance, metres.
        noise: Standard deviation of distances, metres.
        divergence_mrad: Opening angle of a beam.
        layout: Fields of its driver's points.
        stamp: What its driver's stamp means.
    """

    title: str
    source: str
    rate: float
    pattern: Callable[[float], Pattern]
    range: tuple[float, float]
    noise: float
    divergence_mrad: float = 3.0
    layout: Layout = "xyzi"
    stamp: StampOf = "start"


#: Elevations of a VLP-16 in the order in which its lasers fire.
_VLP16 = (-15.0, 1.0, -13.0, 3.0, -11.0, 5.0, -9.0, 7.0, -7.0, 9.0, -5.0, 11.0, -3.0, 13.0, -1.0, 15.0)
#: The same of an HDL-32E: two banks of 16 in turn, 4/3 degrees apart.
_HDL32 = tuple(round(first + 4 / 3 * step, 2) for step in range(16) for first in (-30.67, -9.33))
#: Middle of each channel of an M1 in degrees, from the left.
_M1_AZIMUTHS = (48.0, 24.0, 0.0, -24.0, -48.0)


def _fired(
    elevations: Sequence[float], firing: float, channel: float, top_first: bool = False
) -> Callable[[float], Pattern]:
    """Lasers that fire one after the other, in the same time at any rate; see :func:`spinning`."""

    def make(rate: float) -> Pattern:
        columns = int(1 / rate / firing + 1e-6)
        return spinning(rate, elevations, columns, firing=firing, channel=channel, top_first=top_first)

    return make


def _even(low: float, high: float, count: int, columns: int) -> Callable[[float], Pattern]:
    """Lasers at even elevations, which fire together; ring 0 is the highest."""
    elevations = np.linspace(high, low, count).tolist()
    return lambda rate: spinning(rate, elevations, columns, top_first=True)


def _plane(first: float, last: float, points: int) -> Callable[[float], Pattern]:
    """One laser in the x-y plane, which turns to the left."""
    return lambda rate: spinning(rate, (0.0,), points, (first, last))


#: All models by name.
MODELS: dict[str, ScannerModel] = {
    "velodyne_vlp16": ScannerModel(
        "Velodyne VLP-16 (Puck)",
        "VLP-16 User Manual 63-9243: 16 lasers, 2.304 us apart, 55.296 us a firing; velodyne_pointcloud, "
        "calibration.cpp: ring 0 is the lowest",
        10.0,
        _fired(_VLP16, 55.296e-6, 2.304e-6),
        (0.4, 100.0),
        0.015,
        layout="velodyne",
        stamp="end",
    ),
    "velodyne_hdl32e": ScannerModel(
        "Velodyne HDL-32E",
        "HDL-32E User's Manual 63-9113: 32 lasers, 1.152 us apart, 46.080 us a firing; velodyne_pointcloud, "
        "calibration.cpp: ring 0 is the lowest",
        10.0,
        _fired(_HDL32, 46.080e-6, 1.152e-6),
        (0.4, 100.0),
        0.01,
        layout="velodyne",
        stamp="end",
    ),
    "ouster_os0_128": ScannerModel(
        "Ouster OS0-128, 1024 x 10",
        "OS0 datasheet, revision 6: 90 degrees vertical, 128 channels; beams at even elevations here; "
        "ouster-ros, point_cloud_compose.h: ring is the row, and beam_altitude_angles begin at the top",
        10.0,
        _even(-45.0, 45.0, 128, 1024),
        (0.3, 75.0),
        0.015,
        6.1,
        "ouster",
    ),
    "ouster_os1_64": ScannerModel(
        "Ouster OS1-64, 1024 x 10",
        "OS1 datasheet, revision 6: 45 degrees vertical, 64 channels; beams at even elevations here; "
        "ouster-ros, point_cloud_compose.h: ring is the row, and beam_altitude_angles begin at the top",
        10.0,
        _even(-22.5, 22.5, 64, 1024),
        (0.3, 120.0),
        0.01,
        3.15,
        "ouster",
    ),
    "hesai_xt32": ScannerModel(
        "Hesai PandarXT-32",
        "PandarXT user manual: 32 channels from 15 to -16 degrees, 50 us a firing; nebula, pandar_xt32.hpp: "
        "1.512 us apart; its PandarXT32.csv, and setRing of HesaiLidar_SDK_2.0: channel 0 is the highest",
        10.0,
        _fired(range(15, -17, -1), 50e-6, 1.512e-6, top_first=True),
        (0.05, 120.0),
        0.005,
        1.8,
        "autoware",
    ),
    "robosense_m1": ScannerModel(
        "RoboSense RS-LiDAR-M1",
        "RS-LiDAR-M1 datasheet: solid state, 120 x 25 degrees, 0.2 degrees, 787,500 points/s, 10 Hz; "
        "rs_driver, decoder_RSM1.hpp: 630 x 25 firings of 5 channels, which are the rings; side by side here",
        10.0,
        lambda rate: raster(
            rate, np.linspace(12.5, -12.5, 126).tolist(), 125, *((a + 12.4, a - 12.4) for a in _M1_AZIMUTHS)
        ),
        (0.5, 150.0),
        0.03,
        2.0,
        "autoware",
    ),
    "livox_mid40": ScannerModel(
        "Livox Mid-40",
        "Mid-40 user manual: cone of 38.4 degrees, 100,000 points/s; prisms as in [Liu 2021]; "
        "livox_ros_driver: one line",
        10.0,
        lambda rate: rosette(rate, 100_000, 38.4, (7294 / 60, -4664 / 60)),
        (0.05, 90.0),
        0.02,
        5.0,
        "livox",
    ),
    "livox_mid360": ScannerModel(
        "Livox Mid-360",
        "Mid-360 user manual: 360 x 59 degrees, 200,000 points/s; mirror speeds are estimated; "
        "livox_ros_driver2, pub_handler.cpp: 4 lines in turn",
        10.0,
        lambda rate: oscillating(rate, 200_000, (-7.0, 52.0), 17.31, 199.7, 4),
        (0.1, 70.0),
        0.02,
        5.0,
        "livox",
    ),
    "hokuyo_utm30lx": ScannerModel(
        "Hokuyo UTM-30LX",
        "UTM-30LX specification: 270 degrees, 0.25 degrees, 25 ms, 0.1 to 30 m, 30 mm up to 10 m",
        40.0,
        _plane(-135.0, 135.0, 1081),
        (0.1, 30.0),
        0.01,
        layout="scan",
    ),
    "hokuyo_urg04lx": ScannerModel(
        "Hokuyo URG-04LX",
        "URG-04LX specification: steps 44 to 725 of 1024 a turn, 384 in front, 100 ms, 0.02 to 5.6 m (4 m on "
        "white); urg_node",
        10.0,
        _plane(-340 * 360 / 1024, 341 * 360 / 1024, 682),
        (0.02, 5.6),
        0.01,
        layout="scan",
    ),
    "sick_lms111": ScannerModel(
        "SICK LMS111",
        "LMS1xx operating instructions: 270 degrees, 0.5 degrees at 50 Hz, 0.5 to 20 m, 12 mm",
        50.0,
        _plane(-135.0, 135.0, 541),
        (0.5, 20.0),
        0.012,
        15.0,
        layout="scan",
    ),
    "sick_tim571": ScannerModel(
        "SICK TiM571",
        "TiM5xx operating instructions: 270 degrees, 0.33 degrees at 15 Hz, 0.05 to 25 m, 20 mm",
        15.0,
        _plane(-135.0, 135.0, 811),
        (0.05, 25.0),
        0.02,
        9.0,
        layout="scan",
    ),
}
