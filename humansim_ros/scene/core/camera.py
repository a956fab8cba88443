"""Cameras of a scene: the cameras of its rig (a calibration file) and of its section ``cameras``."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from humansim_ros.cameras.camera import (
    Camera,
    Ideal,
    Region,
    RigPlacement,
    common_point,
    look_at_pose,
    pinhole_of_fov,
    rectify,
)
from humansim_ros.cameras.sensor import DepthSensor, DepthSensorConfig, Sensor
from humansim_ros.errors import CameraError, SceneError, in_section, unknown
from humansim_ros.geometry import ObjectPose, Velocity, matrix_to_quaternion, quaternion_to_matrix
from humansim_ros.render.interface import Backdrop
from humansim_ros.scene.config.camera_config import CameraConfig, RigConfig
from humansim_ros.scene.config.config import SceneConfig, load_config
from humansim_ros.scene.config.timing import CameraTiming
from humansim_ros.scene.core.environment import load_backdrop
from humansim_ros.scene.core.faults import CalibrationError, FaultSchedule, FrameFaults
from humansim_ros.scene.core.names import right_camera
from humansim_ros.scene.core.objects import Robot, Route, robot_of_mount
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.types import Array, Float32Array

if TYPE_CHECKING:
    from humansim_ros.cameras.formats import Calibration


#: Timing of a camera until it is part of a scene.
_EVERY_FRAME = CameraTiming(1.0)


@dataclass(frozen=True)
class CameraPose:
    """Pose of an optical frame: ``R`` (3, 3) and ``t`` (3,), world to optical, metres.

    ``velocity``: velocity in ``map``; None if unknown.
    """

    R: Array
    t: Array
    velocity: Velocity | None = None
    # source of R and t; None if R and t were given
    _in_map: tuple[Array, Array] | None = field(default=None, repr=False)

    @classmethod
    def at(cls, position: Array, rotation: Array, velocity: Velocity | None = None) -> CameraPose:
        """Pose of an optical frame at a position (3,) in ``map``, rotated by a unit quaternion (4,) xyzw.

        Messages carry these numbers: the bits of a pose do not change on the way.
        """
        r = quaternion_to_matrix(rotation).T
        return cls(r, -r @ position, velocity, (position, rotation))

    @property
    def position(self) -> Array:
        """Position (3,) of the optical frame in ``map``, metres."""
        return -self.R.T @ self.t if self._in_map is None else self._in_map[0]

    @property
    def rotation(self) -> Array:
        """Rotation (4,) xyzw of the optical frame in ``map``."""
        return matrix_to_quaternion(self.R.T) if self._in_map is None else self._in_map[1]

    @classmethod
    def of(cls, camera: Camera) -> CameraPose:
        """Pose of a camera that does not move."""
        return cls(camera.R, camera.t)

    @classmethod
    def of_object(cls, pose: ObjectPose) -> CameraPose:
        """Pose and velocity of an optical frame that is an object."""
        return cls.at(pose.position, pose.rotation, pose.velocity)

    def moved(self, seconds: float) -> CameraPose:
        """Pose ``seconds`` later at constant velocity."""
        if self.velocity is None or seconds == 0:
            return self
        turn = scipy.spatial.transform.Rotation.from_rotvec(-seconds * self.velocity.angular)
        r = self.R @ turn.as_matrix()
        return CameraPose(r, -r @ (seconds * self.velocity.linear - self.R.T @ self.t), self.velocity)

    def beside(self, offset: Array) -> CameraPose:
        """Pose of a second camera, ``offset`` (3,) metres away in the optical frame and rigidly attached."""
        turned = self.R.T @ offset
        velocity = None if self.velocity is None else self.velocity.of_point(turned)
        return CameraPose.at(self.position + turned, self.rotation, velocity)


@dataclass(frozen=True, eq=False)
class SceneCamera:
    """A camera of a scene.

    Attributes:
        name: Name in the scene.
        whole: Camera of the whole sensor at its initial pose.
        region: Binning and region of interest.
        sensor: Sensor model.
        route: Trajectory that moves the camera, if any.
        mount: Pose of the optical frame in ``base_link`` of a robot, and the robot; None without a robot.
        backdrop: Image behind everything; a plain colour if None.
        faults: Its faults over time, or None.
        depth_sensor: Depth sensor of the camera, or None.
        left: Name of the left camera if it is the right one of a stereo pair; else empty.
        beside_left: Its position (3,) in the optical frame of that camera, metres.
        timing: Frames of the scene in which it takes a picture.
    """

    name: str
    whole: Camera
    region: Region
    sensor: Sensor
    route: Route | None = None
    mount: tuple[ObjectPose, Robot] | None = None
    backdrop: Backdrop | None = None
    faults: FaultSchedule | None = None
    depth_sensor: DepthSensor | None = None
    left: str = ""
    beside_left: Array = field(default_factory=lambda: np.zeros(3))
    timing: CameraTiming = _EVERY_FRAME

    @classmethod
    def build(cls, name: str, config: CameraConfig, source: SceneSource) -> SceneCamera:
        """Create a camera from its section. Raises HumansimError; ``key`` is relative to ``cameras``."""
        with in_section(name), _scene_keys():
            route = None
            whole = _camera(name, config, source)
            if config.trajectory is not None:
                with in_section("trajectory"):
                    route = Route.read(config.trajectory, source)
                start = CameraPose.of_object(route.at(0.0))
                whole = replace(whole, R=start.R, t=start.t)
            roi = config.roi
            region = Region(None if roi is None else (roi.x, roi.y, roi.width, roi.height), config.binning)
            sensor = Sensor(config.sensor, region.of(whole), name)
            backdrop = None
            if config.background is not None:
                with in_section("background"):
                    backdrop = load_backdrop(source.find(config.background))
            depth = _depth_sensor(name, config.depth_sensor)
        return cls(name, whole, region, sensor, route, None, backdrop, depth_sensor=depth)

    def right(self, baseline: float) -> SceneCamera:
        """Right camera of a stereo pair, with P of CameraInfo as image_geometry's StereoCameraModel needs it.

        ``baseline``: distance along the rows of the rectified images, metres. Raises CameraError if the
        camera has a baseline already.
        """
        p = self.whole.rectified_projection.copy()
        if p[:, 3].any():
            raise CameraError("stereo sets the baseline: P of the left camera has none", key="rectified")
        p[0, 3] = -p[0, 0] * baseline
        name = right_camera(self.name)
        whole = replace(self.whole, rectified=p)
        sensor = Sensor(self.sensor.config, self.region.of(whole), name)
        offset = self.whole.rectification_matrix.T @ np.array([baseline, 0, 0])
        camera = replace(self, name=name, whole=whole, sensor=sensor, depth_sensor=None)
        return replace(camera, left=self.name, beside_left=offset).placed_beside(self)

    def placed_beside(self, left: SceneCamera) -> SceneCamera:
        """The same right camera next to the left camera at its initial pose."""
        return replace(self, whole=replace(self.whole, R=left.whole.R, t=left.whole.t - self.beside_left))

    def mounted_on(self, robot: Robot) -> SceneCamera:
        """The same camera on a robot: its pose in ``map`` becomes its pose in ``base_link``."""
        pose = CameraPose.of(self.whole)
        place = ObjectPose(pose.position, pose.rotation)
        start = CameraPose.of_object(robot.body_at(0.0).carry(place))
        whole = replace(self.whole, R=start.R, t=start.t)
        return replace(self, whole=whole, mount=(place, robot))

    def with_calibration(self, calibrated: Camera) -> SceneCamera:
        """The same camera at its pose with the lens, K and size of another."""
        whole = replace(calibrated, R=self.whole.R, t=self.whole.t)
        sensor = Sensor(self.sensor.config, self.region.of(whole), self.name)
        return replace(self, whole=whole, sensor=sensor)

    def smaller(self, size: tuple[int, int]) -> SceneCamera:
        """The same view in a smaller image (width, height), for pictures, without chromatic aberration, which
        is smaller than one of the larger pixels."""
        raw = self.camera
        sx, sy = size[0] / raw.size[0], size[1] / raw.size[1]
        # the centre of the top-left pixel is (0, 0)
        scale = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
        whole = replace(raw, size=size, K=scale @ raw.K, rectification=None, rectified=None)
        config = self.sensor.config.model_copy(update={"chromatic_aberration": None})
        return replace(self, whole=whole, region=Region(), sensor=Sensor(config, whole, self.name))

    @cached_property
    def camera(self) -> Camera:
        """Camera of ``image_raw`` at its initial pose."""
        return self.region.of(self.whole)

    @property
    def moves(self) -> bool:
        """Whether a trajectory or the robot moves it; ``<camera>/pose`` can move any other camera."""
        return self.route is not None or self.mount is not None

    def pose(self, seconds: float, robot: ObjectPose | None = None) -> CameraPose:
        """Pose and velocity at a scene time in seconds. ``robot``: pose of the body of the robot at this
        time; if None, the robot computes it."""
        if self.mount is not None:
            place, carrier = self.mount
            return CameraPose.of_object((robot or carrier.body_at(seconds)).carry(place))
        if self.route is None:
            return CameraPose.of(self.camera)
        pose = CameraPose.of_object(self.route.at(seconds))
        return pose.beside(self.beside_left) if self.left else pose

    def camera_at(self, pose: CameraPose) -> Camera:
        """Camera of ``image_raw`` at a pose."""
        if pose.R is self.camera.R and pose.t is self.camera.t:
            return self.camera
        return self.camera.at(pose.R, pose.t)

    @property
    def drifts(self) -> bool:
        """Whether a fault moves it away from its calibration."""
        return self._error is not None and self._error.drifts

    def true_pose(self, pose: CameraPose, seconds: float) -> CameraPose:
        """Pose that it really has when the scene gives it a pose at a scene time in seconds."""
        if self._error is None or not self._error.drifts:
            return pose
        return _displaced(pose, *self._error.moved(seconds))

    def published_at(self, pose: CameraPose) -> Camera:
        """Camera of ``image_raw`` as its calibration says when the scene gives it a pose."""
        if self._error is None:
            return self.camera_at(pose)
        pose = _displaced(pose, self._error.rotation, self._error.translation)
        return self._published.at(pose.R, pose.t)

    @cached_property
    def published(self) -> Camera:
        """Camera of the whole sensor as ``camera_info`` says."""
        return self.whole if self._error is None else self._error.published(self.whole)

    @cached_property
    def _published(self) -> Camera:
        """Camera of ``image_raw`` as its calibration says, at its initial pose."""
        return self.camera if self._error is None else self._error.published(self.camera)

    @property
    def _error(self) -> CalibrationError | None:
        return None if self.faults is None else self.faults.calibration

    def light(self, scene_time: int, faults: FrameFaults) -> Float32Array | None:
        """Light (H, 1) or (H, W) of each pixel as a share of the light without faults; None if faults do not
        change the light. ``scene_time``: of the picture, nanoseconds."""
        if self.faults is None:
            return None
        config, sensor = self.faults.config, self.sensor.config
        dirt = self.faults.transmission(self.camera.size)
        if config.flicker is None and config.exposure_steps is None:
            return dirt
        height = self.camera.size[1]
        from_middle = np.arange(height, dtype=float) - (height - 1) / 2
        rows = scene_time * 1e-9 + from_middle * sensor.rolling_shutter
        lamp = self.faults.lamp(rows + faults.trigger_delay, sensor.exposure_time)
        light = (2**faults.stops * lamp[:, None]).astype(np.float32)
        return light if dirt is None else light * dirt

    @cached_property
    def rectified(self) -> Ideal | None:
        """Ideal camera of ``image_rect``; None if ``image_raw`` is ideal already."""
        ideal = rectify(self.camera)
        return None if ideal.camera is ideal.real else ideal

    def rectified_at(self, pose: CameraPose) -> Camera:
        """Camera of ``image_rect`` at a pose."""
        if self.rectified is None:
            return self.camera_at(pose)
        ideal = self.rectified.camera
        if pose.R is self.camera.R and pose.t is self.camera.t:
            return ideal
        rotation = self.camera.rectification_matrix
        return ideal.at(rotation @ pose.R, rotation @ pose.t)

    @property
    def encoding(self) -> str:
        """Encoding of ``image_raw``."""
        return self.sensor.config.encoding

    def rectify(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """``image_rect`` from ``image_raw`` by the published calibration. A Bayer mosaic gets colours."""
        if self.encoding == "bayer_rggb8":
            image = np.asarray(cv2.cvtColor(image, cv2.COLOR_BayerBG2RGB), dtype=np.uint8)
        return image if self.rectified is None else self._published_rectified.to_ideal(image)

    @cached_property
    def _published_rectified(self) -> Ideal:
        return rectify(self.region.of(self.published))


def _displaced(pose: CameraPose, rotation: Array, translation: Array) -> CameraPose:
    """Pose with its optical frame rotated in itself (3, 3), and moved (3,) in ``map``."""
    r = rotation @ pose.R
    return CameraPose(r, -r @ (pose.position + translation), pose.velocity)


def _camera(name: str, config: CameraConfig, source: SceneSource) -> Camera:
    """Camera of a section; at the origin if its pose comes from a trajectory."""
    pose = _stated_pose(config)
    if config.calibration is not None:
        camera = _calibrated(config, source)
    elif config.P is not None:
        camera = Camera.from_projection_matrix(config.P, config.size or _DEFAULT_SIZE)
    else:
        size = config.size or _DEFAULT_SIZE
        fov = float(np.radians(60.0 if config.fov_deg is None else config.fov_deg))
        k = pinhole_of_fov(size, fov) if config.K is None else np.array(config.K)
        stereo = (np.array(m) if m is not None else None for m in (config.rectification, config.rectified))
        lens = (config.distortion, config.distortion_model)
        return Camera(size, k, *(pose or (np.eye(3), np.zeros(3))), *lens, *stereo)
    if pose is not None:
        return replace(camera, R=pose[0], t=pose[1])
    without_pose = np.array_equal(camera.R, np.eye(3)) and not camera.t.any()
    if without_pose and config.calibration is not None and config.trajectory is None:
        source.warn(
            f"cameras.{name}.calibration",
            f"{config.calibration} has no pose: the camera is at the origin and looks up",
        )
    return camera


def _stated_pose(config: CameraConfig) -> tuple[Array, Array] | None:
    """R (3, 3) and t (3,) of a section; None for a section without a pose."""
    if config.R is not None and config.t is not None:
        return np.array(config.R), np.array(config.t)
    if config.position is not None and config.look_at is not None:
        return look_at_pose(config.position, config.look_at, config.up)
    return None


def _calibrated(config: CameraConfig, source: SceneSource) -> Camera:
    """Camera of a calibration file."""
    assert config.calibration is not None
    file = config.calibration
    cameras = read_cameras(file, "calibration", config, source).cameras
    if config.camera is None and len(cameras) > 1:
        raise CameraError(f"{file} has {len(cameras)} cameras ({', '.join(cameras)}): name one", key="camera")
    if config.camera is not None and config.camera not in cameras:
        raise CameraError(unknown("camera", config.camera, cameras, file), key="camera")
    return next(iter(cameras.values())) if config.camera is None else cameras[config.camera]


def read_cameras(file: str, key: str, config: CameraConfig | RigConfig, source: SceneSource) -> Calibration:
    """Read a calibration file with the size, unit and up axis of a section.

    Args:
        file: Path or URL.
        key: Key of the section that names the file.
        config: The section.
        source: Finds the file.

    Raises:
        HumansimError: With the key, relative to the section.
    """
    with in_section(key):
        path = source.find_url(file)
    with in_section("extrinsics"):
        extrinsics = None if config.extrinsics is None else source.find_url(config.extrinsics)
    try:
        # imported here, since the import is slow
        from humansim_ros.cameras.formats import load_calibration

        read = load_calibration(
            path,
            size=config.size,
            unit=config.unit,
            up=config.up_axis,
            extrinsics=extrinsics,
            all_cameras=isinstance(config, CameraConfig),  # the scene may have its pose
        )
    except CameraError as error:
        if error.path is None:  # of size, unit or up axis
            raise
        raise error.within(key) from error
    for name, (width, height) in read.sizes.items():
        if config.size not in (None, (width, height)):
            raise CameraError(f"camera {name} of {file} has images of {width}x{height} pixels", key="size")
    return read


@contextmanager
def _scene_keys() -> Iterator[None]:
    """Give errors of a camera the keys of scene files."""
    try:
        yield
    except CameraError as error:
        if error.path is None and error.key in _SCENE_KEYS:
            raise CameraError(error.message, key=_SCENE_KEYS[error.key]) from None
        raise


#: Parameters of a camera that have another name in scene files.
_SCENE_KEYS = {"model": "distortion_model", "fov": "fov_deg"}
_DEFAULT_SIZE = (640, 480)


def build_cameras(
    config: SceneConfig, source: SceneSource, robot: Robot | None = None
) -> dict[str, SceneCamera]:
    """Cameras of a scene by name, cameras of its rig first. ``robot``: carries the cameras that are mounted
    on it. Raises HumansimError, which names the key of the scene file."""
    cameras: dict[str, SceneCamera] = {}
    if config.rig is not None:
        with in_section("rig"):
            cameras = _build_rig(config.rig, source, config.rate)
    with in_section("cameras"):
        for name, camera in config.cameras.items():
            if name in cameras:
                raise SceneError("the rig has a camera of this name already", key=name)
            built = SceneCamera.build(name, camera, source)
            with in_section(name):
                timing = CameraTiming.of(config.rate, camera.rate, camera.offset)
                cameras[name] = replace(built, timing=timing)
                if camera.stereo is None:
                    continue
                right = cameras[name].right(camera.stereo.baseline)
                if right.name in cameras or right.name in config.cameras:
                    raise SceneError(f"there is another camera {right.name}, its second camera", key="stereo")
                cameras[right.name] = right
    return {name: _completed(camera, config, robot) for name, camera in cameras.items()}


def _completed(camera: SceneCamera, config: SceneConfig, robot: Robot | None) -> SceneCamera:
    """Camera with its mount and its faults."""
    section = config.cameras.get(camera.left or camera.name, config.rig)
    if section is None:
        return camera
    with in_section("rig" if section is config.rig else f"cameras.{camera.left or camera.name}"):
        carrier = robot_of_mount(section.mount, robot)
    if carrier is not None:
        camera = camera.mounted_on(carrier)
    if section.faults is None:
        return camera
    return replace(camera, faults=FaultSchedule(section.faults, camera.name, camera.timing))


def rig_camera_names(path: str | os.PathLike[str]) -> list[str]:
    """Names of the cameras that a scene file takes from its rig. Raises HumansimError with path and key."""
    rig, source = load_config(path).rig, SceneSource.of_file(path)
    if rig is None:
        return []
    with source.locating_errors(), in_section("rig"):
        return list(_rig_cameras(rig, source))


def _build_rig(rig: RigConfig, source: SceneSource, rate: float) -> dict[str, SceneCamera]:
    """Cameras of a rig by name. ``rate``: frames per second of the scene."""
    cameras = _rig_cameras(rig, source)
    region = Region(None, rig.binning)
    originals = [original for original, _ in cameras.values()]
    with in_section("background"):
        backdrops = _backdrops(rig, originals, source)
    timings = _rig_timings(rig, originals, rate)
    depth = {name: _depth_sensor(name, rig.depth_sensor) for name in cameras}
    built = {}
    for name, (original, whole) in cameras.items():
        sensor, backdrop = Sensor(rig.sensor, region.of(whole), name), backdrops.get(original)
        camera = SceneCamera(name, whole, region, sensor, backdrop=backdrop, timing=timings[original])
        built[name] = replace(camera, depth_sensor=depth[name])
    return built


def _rig_timings(rig: RigConfig, names: Sequence[str], rate: float) -> dict[str, CameraTiming]:
    """Timings by the names of cameras in the rig's file. ``rate``: frames per second of the scene."""
    for key, given in (("rate", rig.rate), ("offset", rig.offset)):
        for name in given if isinstance(given, dict) else ():
            with in_section(key), in_section(name):
                _check_rig_name(name, names)
    timings = {}
    for name in names:
        own = rig.rate.get(name) if isinstance(rig.rate, dict) else rig.rate
        offset = rig.offset.get(name, 0.0) if isinstance(rig.offset, dict) else rig.offset
        try:
            timings[name] = CameraTiming.of(rate, own, offset)
        except SceneError as error:
            by_name = isinstance(getattr(rig, error.key or ""), dict)
            raise SceneError(error.message, key=f"{error.key}.{name}" if by_name else error.key) from None
    return timings


def _check_rig_name(name: str, names: Sequence[str]) -> None:
    if name not in names:
        raise SceneError(unknown("camera", name, names, "this rig"))


def _depth_sensor(name: str, config: DepthSensorConfig | None) -> DepthSensor | None:
    with in_section("depth_sensor"), _scene_keys():
        return None if config is None else DepthSensor(config, name)


def rig_placement(rig: RigConfig, source: SceneSource) -> RigPlacement:
    """Pose of the world of a rig's file in ``map``. Raises HumansimError, which names the key."""
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
        raise CameraError(unknown("camera", min(missing), read, rig.file), key="cameras")
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
        raise CameraError(f"{rig.file} has no extrinsics: {hint}", key="file")
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
        text = "the optical axes of the cameras do not meet in front of them: give position instead"
        raise CameraError(text, key="look_at")
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
            _check_rig_name(name, names)
            backdrops[name] = load_backdrop(source.find(file))
    return backdrops


def _topic_name(name: str) -> str:
    """Name of a camera that is valid in ROS topics."""
    plain = re.sub(r"\W", "_", name, flags=re.ASCII).strip("_")
    return plain if plain[:1].isalpha() else f"camera_{plain}"
