"""Table of all calibration formats. Each family of formats has a module.

To add a format, give it a row of ``config/calibration_formats.json``, and in a module here functions that
recognise, read and write it (:func:`calibration_format`). Then add it to :data:`FORMATS` below. The rest of
the package needs no change. ``cameras/formats/calibration.py`` converts units and axes, guesses missing image
sizes, checks cameras, writes files, and reports errors with file, line and key for all formats. The command
line takes the names of formats from :data:`FORMATS`. ``formats/base.py`` has helpers for numbers, names,
lists of cameras and names of lens models.
"""

from humansim_ros.cameras.formats.colmap import COLMAP
from humansim_ros.cameras.formats.datasets import ANIPOSE, ASSOCIATION, CAM, H36M, PANOPTIC, SHELF
from humansim_ros.cameras.formats.devices import K4A, OPEN3D, REALSENSE, ZED
from humansim_ros.cameras.formats.layouts import LAYOUTS
from humansim_ros.cameras.formats.matrices import MATRICES, MATRICES_NPZ
from humansim_ros.cameras.formats.mocap import DLT, EGOEXO, MOTIVE, QUALISYS, THEIA, VICON
from humansim_ros.cameras.formats.opencv import OPENCV, OPENCV_JSON, OPENCV_XML
from humansim_ros.cameras.formats.photogrammetry import BUNDLER, MESHROOM, METASHAPE, OPENMVG
from humansim_ros.cameras.formats.projection import KRTD, MIDDLEBURY, MVSNET, PROJECTION
from humansim_ros.cameras.formats.ros import CAMERA_INFO, INI, KALIBR
from humansim_ros.cameras.formats.scene import SCENE
from humansim_ros.cameras.formats.table import CalibrationFormat
from humansim_ros.cameras.formats.transforms import BLENDER, TRANSFORMS

#: All formats in the order in which they are tried. The first one that recognises a file reads it.
FORMATS: tuple[CalibrationFormat, ...] = (
    *(BUNDLER, MVSNET, EGOEXO, DLT, METASHAPE, VICON, MOTIVE, THEIA, OPENMVG, MESHROOM),
    *(ZED, K4A, BLENDER),
    *(CAMERA_INFO, INI, KALIBR, SCENE),
    *(H36M, ASSOCIATION, PANOPTIC, SHELF, TRANSFORMS, ANIPOSE),
    *(QUALISYS, REALSENSE, OPEN3D),
    *(OPENCV, OPENCV_XML, OPENCV_JSON, MATRICES, MATRICES_NPZ),
    *(CAM, COLMAP, MIDDLEBURY, KRTD, PROJECTION),
)

#: All formats that can be read, in the order in which they are tried. Some cannot be written.
READ_FORMATS = (*LAYOUTS, *FORMATS)
