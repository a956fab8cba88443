"""Settings of cameras in a scene file: their faults (docs/faults.md), single cameras, and rigs."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, GetJsonSchemaHandler, WithJsonSchema, field_validator, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from humansim_ros.cameras.sensor import DepthSensorConfig, SensorConfig
from humansim_ros.files.yaml import Axis, FileName, Section, Share, ShortSection

#: Longest delay, and longest random event, seconds: the schedule looks back as far.
MAX_DELAY, MAX_EVENT = 5.0, 60.0
#: Longest time, seconds, over which bodies are moved at the velocities of their frame.
MAX_TRIGGER_DELAY = 0.1
Vector3 = tuple[float, float, float]
_Row4 = tuple[float, float, float, float]
#: Metres or degrees; values beyond are mistakes.
Bounded = Annotated[float, Field(ge=-1e6, le=1e6)]
BoundedVector3 = tuple[Bounded, Bounded, Bounded]
#: Rectangle on the floor: x, y of two corners.
Area = tuple[Bounded, Bounded, Bounded, Bounded]
#: Object of the scene that a camera is mounted on.
Mount = Literal["robot"]
#: Name of a camera in a calibration file, which may be a number (``coerce_numbers_to_str``).
_CameraOfFile = Annotated[str, WithJsonSchema({"type": ["string", "number"]})]
_Delay = Annotated[float, Field(ge=0, le=MAX_DELAY)]
_Duration = Annotated[float, Field(gt=0, le=MAX_EVENT)]
_Count = Annotated[int, Field(ge=1, le=1000)]
_Time = Annotated[float, Field(ge=0, le=1e6)]
_Stops = Annotated[float, Field(ge=-10, le=10)]
_SpotSize = Annotated[float, Field(gt=0, le=2)]
_Rate = Annotated[float, Field(ge=0.001, le=1000)]
_Offset = Annotated[float, Field(ge=0, le=1e6)]
#: Parts of the JSON schema of a key that say nothing about its values.
_OF_KEYS = ("default", "description", "title")


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError(f"give the smaller number first: [{value[1]:g}, {value[0]:g}]")
    return value


class NumberSection(Section):
    """Section that a number alone can stand for: the value of one of its keys."""

    number_key: ClassVar[str] = "probability"

    @model_validator(mode="before")
    @classmethod
    def _number_alone(cls, value: Any) -> Any:
        is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
        return {cls.number_key: value} if is_number else value

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        section = handler.resolve_ref_schema(handler(core_schema))
        number = {
            key: value for key, value in section["properties"][cls.number_key].items() if key not in _OF_KEYS
        }
        return {"anyOf": [number, section]}


class DropFault(NumberSection):
    """Frames that are lost."""

    probability: Share = Field(description="probability that a loss begins at a frame")
    frames: tuple[_Count, _Count] = Field(
        default=(1, 1), description="least and greatest number of frames that are lost together"
    )

    _check_frames = field_validator("frames")(_ordered)


class _EventFault(NumberSection):
    """Something that lasts for a time, at random or given times."""

    probability: Share = Field(default=0.0, description="probability that it begins at a frame")
    duration: tuple[_Duration, _Duration] = Field(
        default=(1.0, 1.0), description="least and greatest duration, seconds"
    )
    at: tuple[tuple[_Time, _Time], ...] = Field(
        default=(),
        max_length=1000,
        examples=[[[5, 8]]],
        description="start and end of each, seconds of the scene",
    )

    _check_duration = field_validator("duration")(_ordered)

    @field_validator("at")
    @classmethod
    def _check_at(cls, value: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        for start, end in value:
            if start >= end:
                raise ValueError(f"an interval ends after it starts, unlike [{start:g}, {end:g}]")
        return value

    @model_validator(mode="after")
    def _happens(self) -> _EventFault:
        if not self.probability and not self.at:
            raise ValueError("give a probability, or the times as at: [[5, 8]]")
        return self


class FreezeFault(_EventFault):
    """The picture stands; stamps go on."""


class OutageFault(_EventFault):
    """The camera sends nothing, and returns."""


class LateFault(Section):
    """Images are sent late, in order."""

    probability: Share = Field(default=1.0, description="probability that a frame is delayed")
    delay: tuple[_Delay, _Delay] = Field(
        examples=[[0.05, 0.1]], description="least and greatest delay, seconds"
    )

    _check_delay = field_validator("delay")(_ordered)


class OutOfOrderFault(NumberSection):
    """Images that are sent after later ones."""

    probability: Share = Field(description="probability that a frame is held back")
    frames: Annotated[int, Field(ge=1, le=100)] = Field(
        default=1, description="number of later frames that are sent before it"
    )


class DuplicateFault(NumberSection):
    """Images that are sent twice."""

    probability: Share = Field(description="probability that a frame is sent twice")


class ClockFault(NumberSection):
    """The camera's clock is wrong: the stamps of its images and of their camera_info."""

    number_key: ClassVar[str] = "offset"

    offset: float = Field(
        default=0.0, ge=-1e5, le=1e5, description="time that the clock is ahead at the start, seconds"
    )
    drift_ppm: float = Field(
        default=0.0, ge=-1e5, le=1e5, description="microseconds that it gains per second"
    )
    jitter: float = Field(
        default=0.0, ge=0, le=1, description="standard deviation of the error of each stamp, seconds"
    )


class TriggerDelayFault(NumberSection):
    """The camera is triggered late: its picture is of another instant than its stamp."""

    number_key: ClassVar[str] = "delay"

    delay: float = Field(
        default=0.0,
        ge=-MAX_TRIGGER_DELAY,
        le=MAX_TRIGGER_DELAY,
        description="time from the stamp to the middle of the exposure, seconds",
    )
    jitter: float = Field(
        default=0.0, ge=0, le=0.05, description="standard deviation of the delay of each frame, seconds"
    )

    @model_validator(mode="after")
    def _delays(self) -> TriggerDelayFault:
        if not self.delay and not self.jitter:
            raise ValueError("give a delay or a jitter")
        return self


class CalibrationDrift(Section):
    """The camera turns and moves away from its calibration."""

    rotation: float = Field(default=0.0, ge=0, le=360, description="degrees per minute")
    translation: float = Field(default=0.0, ge=0, le=100, description="metres per minute")


class CalibrationFault(Section):
    """The published calibration differs from the camera, in a random direction."""

    rotation: float = Field(default=0.0, ge=0, le=180, description="error of the published rotation, degrees")
    translation: float = Field(
        default=0.0, ge=0, le=100, description="error of the published position, metres"
    )
    focal: float = Field(
        default=0.0,
        ge=0,
        le=0.9,
        description="error of the published focal length, as a share of it; larger or smaller",
    )
    drift: CalibrationDrift | None = Field(
        default=None, description="motion of the camera; what is published stays"
    )

    @model_validator(mode="after")
    def _differs(self) -> CalibrationFault:
        moved = self.drift is not None and (self.drift.rotation or self.drift.translation)
        if not (self.rotation or self.translation or self.focal or moved):
            raise ValueError(
                "give a rotation, a translation, a focal error, or a drift with one of the first two"
            )
        return self


class FlickerFault(Section):
    """The light flickers, as 1 + depth cos(2 pi frequency t)."""

    frequency: float = Field(
        gt=0, le=1e5, examples=[100], description="maxima of the light per second; mains have 100 or 120"
    )
    depth: Share = Field(
        default=0.5, description="(brightest - darkest) / (brightest + darkest) of the light"
    )


class ExposureStepsFault(NumberSection):
    """The exposure changes in steps, as with an automatic exposure."""

    probability: Share = Field(description="probability that the exposure steps at a frame")
    stops: tuple[_Stops, _Stops] = Field(
        default=(-1.0, 1.0), description="least and greatest exposure after a step, in stops"
    )

    _check_stops = field_validator("stops")(_ordered)


class DirtFault(NumberSection):
    """Spots on the lens, out of focus."""

    number_key: ClassVar[str] = "spots"

    spots: _Count = Field(description="number of spots")
    size: tuple[_SpotSize, _SpotSize] = Field(
        default=(0.03, 0.12), description="least and greatest diameter, as a share of the image width"
    )
    opacity: Share = Field(default=0.7, description="light that the middle of a spot takes, as a share")

    _check_size = field_validator("size")(_ordered)


class FaultsConfig(Section):
    """Faults of a camera."""

    seed: int = Field(default=0, ge=0, description="the same seed gives the same faults")
    drop: DropFault | None = Field(default=None, description="frames that are lost")
    freeze: FreezeFault | None = Field(default=None, description="the picture stands, stamps go on")
    outage: OutageFault | None = Field(default=None, description="the camera dies and returns")
    late: LateFault | None = Field(default=None, description="images are sent late")
    out_of_order: OutOfOrderFault | None = Field(default=None, description="images are sent after later ones")
    duplicate: DuplicateFault | None = Field(default=None, description="images are sent twice")
    clock: ClockFault | None = Field(default=None, description="wrong stamps of images")
    trigger_delay: TriggerDelayFault | None = Field(
        default=None, description="the picture is of another instant than its stamp"
    )
    calibration: CalibrationFault | None = Field(
        default=None, description="what is published differs from the camera"
    )
    flicker: FlickerFault | None = Field(default=None, description="the light flickers")
    exposure_steps: ExposureStepsFault | None = Field(default=None, description="the exposure steps")
    dirt: DirtFault | None = Field(default=None, description="spots on the lens")


class TrajectoryConfig(ShortSection):
    """Trajectory of a camera."""

    file: FileName = Field(description="a trajectory in the format of the TUM RGB-D benchmark")
    end: Literal["clamp", "loop", "ping_pong"] = Field(
        default="clamp", description="after the last pose: stay, start again, or go back"
    )
    offset: float = Field(default=0.0, description="time that the trajectory is ahead of the scene, seconds")
    speed: float = Field(default=1.0, ge=0, le=100, description="seconds of the file per second")


class StereoConfig(NumberSection):
    """Second camera to the right of a camera, of the same kind."""

    number_key: ClassVar[str] = "baseline"

    baseline: float = Field(
        gt=0, le=100, description="distance between the two cameras along the rows of their images, metres"
    )


class RegionConfig(Section):
    """Region of interest in pixels of the sensor."""

    x: int = Field(default=0, ge=0)
    y: int = Field(default=0, ge=0)
    width: int = Field(gt=0)
    height: int = Field(gt=0)


class CameraConfig(Section):
    """One camera: its intrinsics (fov_deg, K, P or calibration) and its pose (position and look_at, R and t,
    trajectory, P or calibration).
    """

    model_config = ConfigDict(coerce_numbers_to_str=True)  # cameras of files may have the names 0, 1, 2

    size: tuple[int, int] | None = Field(
        default=None,
        examples=[[640, 480]],
        description="width, height in pixels; from the calibration, or 640, 480, if absent",
    )
    calibration: FileName | None = Field(
        default=None, description="a calibration file, or a file:// or package:// URL"
    )
    extrinsics: FileName | None = Field(
        default=None, description="a file with the extrinsics, if the calibration file has only intrinsics"
    )
    camera: _CameraOfFile | None = Field(
        default=None, description="name of a camera in that file; its only camera if absent"
    )
    unit: float | None = Field(
        default=None, gt=0, description="metres per unit of that file; as its format defines if absent"
    )
    up_axis: Axis | None = Field(
        default=None, description="up axis of that file; as its format defines if absent"
    )
    position: Vector3 | None = Field(
        default=None, examples=[[3.1, 2.8, 2.2]], description="center of the camera in map, metres"
    )
    look_at: Vector3 | None = Field(
        default=None, examples=[[0, 0, 0.8]], description="point of map at the image center, metres"
    )
    up: Vector3 = Field(
        default=(0.0, 0.0, 1.0), description="direction that points up in the image; with look_at only"
    )
    fov_deg: float | None = Field(
        default=None, gt=0, lt=180, description="horizontal field of view without distortion"
    )
    K: tuple[Vector3, Vector3, Vector3] | None = Field(
        default=None, examples=[[[620, 0, 319.5], [0, 620, 239.5], [0, 0, 1]]], description="intrinsics"
    )
    R: tuple[Vector3, Vector3, Vector3] | None = Field(
        default=None,
        examples=[[[0, 1, 0], [0, 0, -1], [-1, 0, 0]]],
        description="rotation from map to the optical frame",
    )
    t: Vector3 | None = Field(
        default=None,
        examples=[[0.1, 1.2, 3.4]],
        description="translation from map to the optical frame, metres",
    )
    P: tuple[_Row4, _Row4, _Row4] | None = Field(default=None, description="projection matrix K [R | t]")
    distortion: tuple[float, ...] = Field(default=(), description="coefficients in the order of ROS")
    distortion_model: Literal["plumb_bob", "rational_polynomial", "equidistant"] | None = Field(
        default=None, description="chosen by the number of coefficients if absent"
    )
    rectification: tuple[Vector3, Vector3, Vector3] | None = Field(
        default=None,
        description="R of CameraInfo: rotation from the optical frame to the frame of image_rect",
    )
    rectified: tuple[_Row4, _Row4, _Row4] | None = Field(
        default=None, description="P of CameraInfo, with the baseline of a stereo camera"
    )
    trajectory: TrajectoryConfig | None = Field(default=None, description="moves the camera")
    stereo: StereoConfig | None = Field(
        default=None,
        description="with a second camera: right for a camera that is named left, else <name>_right",
    )
    mount: Mount | None = Field(
        default=None, description="robot: the camera moves with it, and its pose is in base_link, not in map"
    )
    rate: _Rate | None = Field(
        default=None, description="pictures per second, a whole part of the rate of the scene; that if absent"
    )
    offset: _Offset = Field(
        default=0.0, description="time of its first picture, seconds; a whole number of frames of the scene"
    )
    binning: tuple[int, int] = Field(
        default=(1, 1), description="pixels of the sensor per pixel along x and y"
    )
    roi: RegionConfig | None = Field(default=None, description="region of interest of the sensor")
    sensor: SensorConfig = Field(default=SensorConfig.model_construct(), description="model of the sensor")
    depth_sensor: DepthSensorConfig | None = Field(
        default=None, description="depth sensor beside the colour sensor; none if absent"
    )
    faults: FaultsConfig | None = Field(default=None, description="faults of the camera; none if absent")
    background: FileName | None = Field(
        default=None, description="image behind everything; the background of the world if absent"
    )

    @model_validator(mode="after")
    def _one_way(self) -> CameraConfig:
        if self.mount is not None and self.trajectory is not None:
            raise ValueError("a camera with a mount cannot have a trajectory: the robot moves it")
        whole = self.calibration is not None or self.P is not None
        seeing = {"fov_deg": self.fov_deg, "K": self.K, "P": self.P, "calibration": self.calibration}
        given = [key for key, value in seeing.items() if value is not None]
        if len(given) > 1:
            raise ValueError(f"the intrinsics are given by {' and by '.join(given)}: give one of them")
        for pair in (("position", "look_at"), ("R", "t")):
            if (getattr(self, pair[0]) is None) != (getattr(self, pair[1]) is None):
                raise ValueError(f"{pair[0]} and {pair[1]} go together: give both")
        standing = {"position, look_at": self.position, "R, t": self.R, "trajectory": self.trajectory}
        places = [key for key, value in standing.items() if value is not None]
        sources = [*places, "P"] if self.P is not None else places
        if len(sources) > 1:
            raise ValueError(f"the pose is given by {' and by '.join(sources)}: give one of them")
        if not places and not whole:
            raise ValueError(
                "the camera has no pose: give position and look_at, R and t, a trajectory, P, or a "
                "calibration file"
            )
        if whole and (self.distortion or self.distortion_model):
            raise ValueError("distortion goes with K or fov_deg only")
        if whole and (self.rectification or self.rectified):
            raise ValueError("rectification and rectified go with K or fov_deg only")
        if self.calibration is None and (self.camera or self.unit or self.up_axis or self.extrinsics):
            raise ValueError("camera, unit, up_axis and extrinsics go with a calibration file")
        return self


class RigConfig(ShortSection):
    """Cameras of a calibration file."""

    model_config = ConfigDict(coerce_numbers_to_str=True)

    file: FileName = Field(description="a calibration file, or a file:// or package:// URL")
    extrinsics: FileName | None = Field(
        default=None, description="a file with the extrinsics, if that file has only intrinsics"
    )
    cameras: tuple[_CameraOfFile, ...] | None = Field(
        default=None, min_length=1, description="names of cameras in the file; all if absent"
    )
    size: tuple[int, int] | None = Field(
        default=None, examples=[[640, 480]], description="width, height in pixels, if the file has none"
    )
    unit: float | None = Field(
        default=None, gt=0, description="metres per unit of that file; as its format defines if absent"
    )
    up_axis: Axis | None = Field(
        default=None, description="up axis of that file; as its format defines if absent"
    )
    position: BoundedVector3 | None = Field(
        default=None, description="position of the origin of that file in map, metres; 0 0 0 if absent"
    )
    rotation_deg: BoundedVector3 = Field(
        default=(0.0, 0.0, 0.0),
        description="rotation of that file in map: degrees about the x axis of map, then y, then z",
    )
    look_at: BoundedVector3 | None = Field(
        default=None,
        description="in place of position: point of map where the optical axes of the cameras meet",
    )
    mount: Mount | None = Field(
        default=None, description="robot: the cameras move with it, and base_link takes the place of map"
    )
    rate: _Rate | dict[str, _Rate] | None = Field(
        default=None,
        description="pictures per second: one number, or a number for each name in the calibration file; a "
        "whole part of the rate of the scene, and that for cameras without",
    )
    offset: _Offset | dict[str, _Offset] = Field(
        default=0.0,
        description="time of the first picture, seconds, in the same way; a whole number of frames of the "
        "scene",
    )
    binning: tuple[int, int] = Field(
        default=(1, 1), description="pixels of the sensor per pixel along x and y"
    )
    sensor: SensorConfig = Field(default=SensorConfig.model_construct(), description="model of the sensors")
    depth_sensor: DepthSensorConfig | None = Field(
        default=None, description="a depth sensor beside each camera; none if absent"
    )
    faults: FaultsConfig | None = Field(default=None, description="faults of the cameras; none if absent")
    background: FileName | dict[str, FileName] | None = Field(
        default=None,
        description="image behind everything: one file, where {name} is the name of the camera in the "
        "calibration file, or a file for each of these names; the background of the world if absent",
    )

    @model_validator(mode="after")
    def _one_position(self) -> RigConfig:
        if self.position is not None and self.look_at is not None:
            raise ValueError("the rig is placed by position and by look_at: give one of them")
        return self
