"""The cameras of a scene: those of its rig (a calibration file) and those of its ``cameras`` section."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from humansim_ros.camera import Camera
from humansim_ros.camera.region import Region
from humansim_ros.errors import CameraError, SceneError
from humansim_ros.render.renderer import Backdrop
from humansim_ros.scene.backdrops import load_backdrop
from humansim_ros.scene.camera import SceneCamera, _placed, _read
from humansim_ros.scene.config import RigConfig, SceneConfig, line_of_key
from humansim_ros.sensor import Sensor


def build_cameras(config: SceneConfig, scene: Path) -> dict[str, SceneCamera]:
    """The cameras of a scene file, those of its rig first. Raises CameraError or SceneError with file and
    key.
    """
    cameras = build_rig(config, scene)
    for name, camera in config.cameras.items():
        if name in cameras:
            key = f"cameras.{name}"
            line = line_of_key(scene, key)
            raise SceneError("the rig has a camera of this name already", path=scene, line=line, key=key)
        try:
            cameras[name] = SceneCamera.build(name, camera, scene)
        except CameraError as error:
            raise _placed(error, scene, f"cameras.{name}") from None
    return cameras


def build_rig(config: SceneConfig, scene: Path) -> dict[str, SceneCamera]:
    """The cameras that a scene file takes from a calibration file as its rig. Raises CameraError, or
    SceneError for their photographs.
    """
    rig, found = config.rig, rig_cameras(config.rig, scene)
    if rig is None:
        return {}
    region, cameras = Region(None, rig.binning), dict[str, SceneCamera]()
    backdrops = _backdrops(rig, [original for original, _ in found.values()], scene)
    try:
        for name, (original, whole) in found.items():
            sensor = Sensor(rig.sensor, region.of(whole), name)
            cameras[name] = SceneCamera(name, whole, region, sensor, backdrop=backdrops.get(original))
    except CameraError as error:
        raise _placed(error, scene, "rig") from None
    return cameras


def rig_cameras(rig: RigConfig | None, scene: Path) -> dict[str, tuple[str, Camera]]:
    """By their names in ROS, what the cameras of a rig are called in their file, and what they are there.
    Raises CameraError.
    """
    if rig is None:
        return {}
    cameras: dict[str, tuple[str, Camera]] = {}
    try:
        found = _read(rig.file, "file", scene, rig)
        missing = set(rig.cameras or ()) - set(found)
        if missing:
            known = ", ".join(found)
            raise CameraError(f"no camera {min(missing)!r} in {rig.file}; there are {known}", key="cameras")
        for original in rig.cameras or found:
            name = _topic_name(original)
            if name in cameras:
                raise CameraError(f"two of its cameras would be {name} in ROS: rename one", key="cameras")
            cameras[name] = original, found[original]
    except CameraError as error:
        raise _placed(error, scene, "rig") from None
    return cameras


def _backdrops(rig: RigConfig, names: Sequence[str], scene: Path) -> dict[str, Backdrop]:
    """Photographs of a rig by the names that cameras have in its file. SceneError with the key."""
    key = "rig.background"
    if isinstance(rig.background, str):
        files = {name: rig.background.replace("{name}", name) for name in names}
        # by file: one that all cameras have is kept once
        read = {file: load_backdrop(file, scene, key) for file in dict.fromkeys(files.values())}
        return {name: read[file] for name, file in files.items()}
    files = rig.background or {}
    for name in files.keys() - {*names}:
        key, message = f"{key}.{name}", f"no camera {name!r} in this rig; there are {', '.join(names)}"
        raise SceneError(message, path=scene, line=line_of_key(scene, key), key=key)
    return {name: load_backdrop(file, scene, f"{key}.{name}") for name, file in files.items()}


def _topic_name(name: str) -> str:
    """A camera's name in a file as ROS topics may have it."""
    plain = re.sub(r"\W", "_", name, flags=re.ASCII).strip("_")
    return plain if plain[:1].isalpha() else f"camera_{plain}"
