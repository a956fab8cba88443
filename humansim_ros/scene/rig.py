"""Cameras of a scene: those of its rig (a calibration file) and those of its ``cameras`` section."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from humansim_ros.camera.camera import Camera
from humansim_ros.camera.placement import RigPlacement, common_point
from humansim_ros.camera.region import Region
from humansim_ros.errors import CameraError, SceneError, did_you_mean, in_section
from humansim_ros.render.renderer import Backdrop
from humansim_ros.scene.backdrops import load_backdrop
from humansim_ros.scene.camera import SceneCamera, read_cameras
from humansim_ros.scene.config import RigConfig, SceneConfig, load_config
from humansim_ros.scene.faults import FaultSchedule
from humansim_ros.scene.source import SceneSource
from humansim_ros.sensor import Sensor

if TYPE_CHECKING:
    from humansim_ros.camera.calibration import Calibration


def build_cameras(config: SceneConfig, source: SceneSource) -> dict[str, SceneCamera]:
    """Create the cameras of a scene by name, those of its rig first. Raises HumansimError with the key."""
    cameras: dict[str, SceneCamera] = {}
    if config.rig is not None:
        with in_section("rig"):
            cameras = _build_rig(config.rig, source)
    with in_section("cameras"):
        for name, camera in config.cameras.items():
            if name in cameras:
                raise SceneError("the rig has a camera of this name already", key=name)
            cameras[name] = SceneCamera.build(name, camera, source)
    return {name: _with_faults(camera, config) for name, camera in cameras.items()}


def _with_faults(camera: SceneCamera, config: SceneConfig) -> SceneCamera:
    section = config.cameras.get(camera.name, config.rig)
    if section is None or section.faults is None:
        return camera
    return replace(camera, faults=FaultSchedule(section.faults, camera.name, config.rate))


def rig_camera_names(path: str | os.PathLike[str]) -> list[str]:
    """Names of the cameras that a scene file takes from its rig. Raises HumansimError with path and key."""
    rig, source = load_config(path).rig, SceneSource.of_file(path)
    if rig is None:
        return []
    with source.locating_errors(), in_section("rig"):
        return list(_rig_cameras(rig, source))


def _build_rig(rig: RigConfig, source: SceneSource) -> dict[str, SceneCamera]:
    cameras = _rig_cameras(rig, source)
    region = Region(None, rig.binning)
    with in_section("background"):
        backdrops = _backdrops(rig, [original for original, _ in cameras.values()], source)
    return {
        name: SceneCamera(
            name,
            whole,
            region,
            Sensor(rig.sensor, region.of(whole), name),
            backdrop=backdrops.get(original),
        )
        for name, (original, whole) in cameras.items()
    }


def rig_placement(rig: RigConfig, source: SceneSource) -> RigPlacement:
    """Pose of the world of a rig's file in ``map``. Raises HumansimError with the key."""
    with source.locating_errors(), in_section("rig"):
        return _placement(rig, [camera for _, camera in _file_cameras(rig, source).values()])


def _rig_cameras(rig: RigConfig, source: SceneSource) -> dict[str, tuple[str, Camera]]:
    """Name in the file and camera in ``map``, by name in ROS."""
    cameras = _file_cameras(rig, source)
    placement = _placement(rig, [camera for _, camera in cameras.values()])
    return {name: (original, placement.camera(camera)) for name, (original, camera) in cameras.items()}


def _file_cameras(rig: RigConfig, source: SceneSource) -> dict[str, tuple[str, Camera]]:
    """Name in the file and camera in the world of the file, by name in ROS."""
    cameras: dict[str, tuple[str, Camera]] = {}
    read = _with_poses(rig, read_cameras(rig.file, "file", rig, source), source)
    missing = set(rig.cameras or ()) - set(read)
    if missing:
        known = ", ".join(read) + did_you_mean(min(missing), read)
        raise CameraError(f"no camera {min(missing)!r} in {rig.file}; there are {known}", key="cameras")
    for original in rig.cameras or read:
        name = _topic_name(original)
        if name in cameras:
            raise CameraError(f"two of its cameras would be {name} in ROS: rename one", key="cameras")
        cameras[name] = original, read[original]
    return cameras


def _with_poses(rig: RigConfig, read: Calibration, source: SceneSource) -> dict[str, Camera]:
    """Cameras of the rig's file that have extrinsics; a single camera may be placed without them."""
    if len(read.cameras) == 1 and (rig.position is not None or any(rig.rotation_deg)):
        return read.cameras
    posed = {name: camera for name, camera in read.cameras.items() if name in read.posed}
    missing = [name for name in read.cameras if name not in posed and name in (rig.cameras or read.cameras)]
    if not posed:
        hint = "give each of its cameras in 'cameras', with calibration and a pose"
        message = f"{rig.file} has no extrinsics: {hint}"
        raise CameraError(message, key="file")
    if missing:
        source.warn("rig.file", f"left out, because they have no extrinsics: {', '.join(missing[:4])}")
    return posed


def _placement(rig: RigConfig, cameras: Sequence[Camera]) -> RigPlacement:
    """Pose of the world of the rig's file in ``map``."""
    if rig.look_at is None:
        return RigPlacement.from_degrees(rig.rotation_deg, rig.position or (0.0, 0.0, 0.0))
    turned = RigPlacement.from_degrees(rig.rotation_deg)
    point = common_point(turned.camera(camera) for camera in cameras)
    if point is None:
        message = "the optical axes of the cameras do not meet in front of them: give position instead"
        raise CameraError(message, key="look_at")
    return turned.moved(rig.look_at - point)


def _backdrops(rig: RigConfig, names: Sequence[str], source: SceneSource) -> dict[str, Backdrop]:
    """Photographs by the names of cameras in the rig's file."""
    if isinstance(rig.background, str):
        files = {name: rig.background.replace("{name}", name) for name in names}
        # by file: one photograph for all cameras is in memory once
        read = {file: load_backdrop(source.find(file)) for file in dict.fromkeys(files.values())}
        return {name: read[file] for name, file in files.items()}
    backdrops: dict[str, Backdrop] = {}
    for name, file in (rig.background or {}).items():
        with in_section(name):
            if name not in names:
                known = ", ".join(names) + did_you_mean(name, names)
                raise SceneError(f"no camera {name!r} in this rig; there are {known}")
            backdrops[name] = load_backdrop(source.find(file))
    return backdrops


def _topic_name(name: str) -> str:
    """Name of a camera that is valid in ROS topics."""
    plain = re.sub(r"\W", "_", name, flags=re.ASCII).strip("_")
    return plain if plain[:1].isalpha() else f"camera_{plain}"
