"""Cameras: projection and calibration."""

from humansim_ros.camera.calibration import read_calibration, resolve_url, write_calibration
from humansim_ros.camera.camera import Camera

__all__ = ["Camera", "read_calibration", "resolve_url", "write_calibration"]
