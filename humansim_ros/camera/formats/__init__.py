"""The forms that calibration files have, one module per family; calibration.py reads and writes them.

A new one: a :class:`CalibrationFormat` in a module here, and its place in :data:`FORMATS`.
"""

from humansim_ros.camera.formats.base import CalibrationFormat, CalibrationSource, FilePosition, RawCamera
from humansim_ros.camera.formats.colmap import COLMAP
from humansim_ros.camera.formats.datasets import H36M, PANOPTIC, SHELF
from humansim_ros.camera.formats.kalibr import KALIBR
from humansim_ros.camera.formats.krtd import KRTD
from humansim_ros.camera.formats.middlebury import MIDDLEBURY
from humansim_ros.camera.formats.opencv import OPENCV, OPENCV_JSON, OPENCV_XML
from humansim_ros.camera.formats.projection import PROJECTION
from humansim_ros.camera.formats.ros import CAMERA_INFO, INI
from humansim_ros.camera.formats.scene import SCENE
from humansim_ros.camera.formats.thesis import CAM

#: In the order in which they are tried: the first that knows a file reads it.
FORMATS: tuple[CalibrationFormat, ...] = (
    *(CAMERA_INFO, INI, KALIBR, SCENE),
    *(H36M, PANOPTIC, SHELF),
    *(OPENCV, OPENCV_XML, OPENCV_JSON),
    *(CAM, COLMAP, MIDDLEBURY, KRTD, PROJECTION),
)

__all__ = ["FORMATS", "CalibrationFormat", "CalibrationSource", "FilePosition", "RawCamera"]
