"""Cameras: projection, lenses, calibration files, ideal cameras, rigs and trajectories."""

from typing import TYPE_CHECKING

from humansim_ros import lazy_exports

if TYPE_CHECKING:
    from humansim_ros.camera.calibration import Calibration as Calibration
    from humansim_ros.camera.calibration import load_calibration as load_calibration
    from humansim_ros.camera.calibration import read_calibration as read_calibration
    from humansim_ros.camera.calibration import resolve_url as resolve_url
    from humansim_ros.camera.calibration import write_calibration as write_calibration
    from humansim_ros.camera.camera import Camera as Camera
    from humansim_ros.camera.camera import Region as Region
    from humansim_ros.camera.coverage import Coverage as Coverage
    from humansim_ros.camera.ideal import Ideal as Ideal
    from humansim_ros.camera.ideal import idealize as idealize
    from humansim_ros.camera.ideal import rectify as rectify
    from humansim_ros.camera.lens import Lens as Lens
    from humansim_ros.camera.trajectory import Trajectory as Trajectory

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "Calibration": "calibration",
        "Camera": "camera",
        "Coverage": "coverage",
        "Ideal": "ideal",
        "Lens": "lens",
        "Region": "camera",
        "Trajectory": "trajectory",
        "idealize": "ideal",
        "load_calibration": "calibration",
        "read_calibration": "calibration",
        "rectify": "ideal",
        "resolve_url": "calibration",
        "write_calibration": "calibration",
    },
)
