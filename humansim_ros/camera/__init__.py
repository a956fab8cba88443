"""Cameras: projection and calibration."""

from humansim_ros.camera.camera import Camera

__all__ = ["Camera"]
