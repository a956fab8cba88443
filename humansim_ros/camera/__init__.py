"""Cameras: projection, lenses, calibration files, ideal cameras, rigs and trajectories."""

from humansim_ros.camera.calibration import (
    Calibration,
    load_calibration,
    read_calibration,
    resolve_url,
    write_calibration,
)
from humansim_ros.camera.camera import Camera
from humansim_ros.camera.idealize import Ideal, idealize, rectify
from humansim_ros.camera.lens import Lens
from humansim_ros.camera.region import Region
from humansim_ros.camera.trajectory import Trajectory

__all__ = [
    "Calibration",
    "Camera",
    "Ideal",
    "Lens",
    "Region",
    "Trajectory",
    "idealize",
    "load_calibration",
    "read_calibration",
    "rectify",
    "resolve_url",
    "write_calibration",
]
