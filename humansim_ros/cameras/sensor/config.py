"""Settings of image sensors (docs/sensors.md) and of depth sensors (docs/depth_cameras.md) in a scene file.

By default all effects are off.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, get_args

import numpy as np
from pydantic import Field, ValidationInfo, field_validator, model_validator

from humansim_ros.files.reading import read_table
from humansim_ros.files.yaml import Section, Share, ShortSection

Encoding = Literal["rgb8", "bgr8", "mono8", "bayer_rggb8"]
Factor = Annotated[float, Field(gt=0, le=100)]
Pixels = Annotated[float, Field(ge=-100, le=100)]
Coefficient = Annotated[float, Field(ge=-10, le=10)]


class Noise(Section):
    """Shot noise, dark noise and read noise [EMVA 1288]."""

    full_well: float = Field(
        default=10_000.0, ge=10, le=1e7, description="electrons that saturate a pixel; white at exposure 1"
    )
    read_noise: float = Field(
        default=2.5, ge=0, le=1e5, description="standard deviation without light, electrons"
    )
    dark_current: float = Field(
        default=0.0, ge=0, le=1e7, description="electrons per second of exposure_time without light"
    )


class Vignetting(Section):
    """Loss of light towards the corners; several factors are multiplied."""

    cos4: bool = Field(default=False, description="natural falloff: cos^4 of the angle to the optical axis")
    corner: Share = Field(
        default=0.0, description="fraction lost at the farthest corner; proportional to the squared distance"
    )
    polynomial: tuple[Coefficient, Coefficient, Coefficient] = Field(
        default=(0.0, 0.0, 0.0),
        description="a, b, c of 1 + a r^2 + b r^4 + c r^6; r is 1 at the farthest corner",
    )

    @field_validator("polynomial")
    @classmethod
    def _check_not_negative(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        squared = np.linspace(0, 1, 257)
        if np.polyval([*value[::-1], 1.0], squared).min() < 0:
            raise ValueError("the falloff is negative between the centre and the corner")
        return value


class ChromaticAberration(Section):
    """Magnification of red and blue relative to green, about the principal point."""

    red: Pixels = Field(default=0.0, description="outward shift at the farthest corner, pixels")
    blue: Pixels = Field(default=0.0, description="outward shift at the farthest corner, pixels")


class SensorConfig(Section):
    """Effects of the sensor on rendered images."""

    encoding: Encoding = Field(default="rgb8", description="encoding of image_raw")
    exposure_time: float = Field(
        default=0.0, ge=0, le=10, description="exposure time of a row, seconds; causes motion blur"
    )
    rolling_shutter: float = Field(
        default=0.0,
        ge=0,
        le=0.01,
        description="time from row to row, seconds, from the top; 0 is a global shutter",
    )
    samples: int = Field(
        default=8, ge=1, le=256, description="images rendered for a frame with motion blur or rolling shutter"
    )
    exposure: Factor = Field(
        default=1.0, description="factor of the collected light; 1 is the rendered light"
    )
    gain_db: float = Field(
        default=0.0, ge=0, le=72, description="amplification after the pixel; 20 dB is a factor of ten"
    )
    white_balance: tuple[Factor, Factor, Factor] = Field(
        default=(1.0, 1.0, 1.0), description="amplification of red, green and blue after the pixel"
    )
    black_level: float = Field(
        default=0.0, ge=0, le=128, description="value without light, of 255, before the response curve"
    )
    noise: Noise | None = None
    vignetting: Vignetting | None = None
    chromatic_aberration: ChromaticAberration | None = None
    response: Literal["srgb", "linear"] | float = Field(
        default="srgb",
        description="curve from light to values: srgb, linear, or a number g for light^(1 / g)",
    )
    jpeg: int | None = Field(
        default=None, ge=1, le=100, description="JPEG quality of a compression that is decoded again"
    )
    seed: int = Field(default=0, ge=0, description="seed of the noise")

    @field_validator("response", mode="plain")
    @classmethod
    def _check_response(cls, value: Any) -> str | float:
        if value == "srgb" or value == "linear":
            return str(value)
        if isinstance(value, (int, float)) and not isinstance(value, bool) and 0.1 <= value <= 10:
            return float(value)
        raise ValueError("must be srgb, linear, or a number from 0.1 to 10")

    @field_validator("samples")
    @classmethod
    def _check_samples(cls, value: int, info: ValidationInfo) -> int:
        if value < 2 and info.data.get("rolling_shutter"):
            raise ValueError("a rolling shutter needs at least 2 samples")
        return value

    @field_validator("noise")
    @classmethod
    def _check_exposure_time(cls, value: Noise | None, info: ValidationInfo) -> Noise | None:
        if value is not None and value.dark_current and info.data.get("exposure_time") == 0:
            raise ValueError("dark_current needs an exposure_time")
        return value

    @field_validator("white_balance")
    @classmethod
    def _check_white_balance(
        cls, value: tuple[float, float, float], info: ValidationInfo
    ) -> tuple[float, float, float]:
        if info.data.get("encoding") == "mono8" and len(set(value)) > 1:
            raise ValueError("a mono8 camera has no white balance")
        return value

    @field_validator("jpeg")
    @classmethod
    def _check_jpeg(cls, value: int | None, info: ValidationInfo) -> int | None:
        if value is not None and info.data.get("encoding") == "bayer_rggb8":
            raise ValueError("bayer_rggb8 cannot be compressed: JPEG would mix the colours of its pixels")
        return value


Model = Literal["structured_light", "active_stereo", "time_of_flight"]
Preset = Literal[
    "kinect_v1", "kinect_v2", "azure_kinect_nfov", "azure_kinect_wfov", "realsense_d435", "realsense_d455"
]
#: Largest depth of 16UC1 images (65535 mm), metres.
MAX_DEPTH = 65.535
_Offset = Annotated[float, Field(ge=-10, le=10)]
_Angle = Annotated[float, Field(ge=-360, le=360)]
_Row = tuple[float, float, float]
_Distance = Annotated[float, Field(ge=0.01, le=MAX_DEPTH)]

_TABLE = read_table("depth_sensors")
#: Keys of each model with their defaults. Other models do not have these keys.
MODEL_KEYS: dict[str, dict[str, float | None]] = _TABLE["models"]
#: Keys of each preset (sensors by name). docs/depth_cameras.md names the sources.
PRESETS: dict[str, dict[str, Any]] = _TABLE["presets"]


class DepthSensorConfig(ShortSection):
    """Depth sensor of a camera: optics of its own beside the colour optics, and its errors."""

    short_key: ClassVar[str] = "preset"

    preset: Preset | None = Field(default=None, description="a known sensor; other keys change its settings")
    model: Model | None = Field(default=None, description="how it measures; as the preset if absent")
    size: tuple[int, int] = Field(default=(640, 480), description="width, height of its image, pixels")
    fov_deg: float | None = Field(
        default=None, gt=0, lt=180, description="horizontal field of view; 60 if it is absent and K, too"
    )
    K: tuple[_Row, _Row, _Row] | None = Field(
        default=None, description="intrinsics in place of fov_deg; its images have no distortion"
    )
    position: tuple[_Offset, _Offset, _Offset] = Field(
        default=(0.0, 0.0, 0.0), description="its optical centre in the optical frame of the camera, metres"
    )
    rotation_deg: tuple[_Angle, _Angle, _Angle] = Field(
        default=(0.0, 0.0, 0.0),
        description="its rotation: degrees about the x axis of that frame, then y, then z",
    )
    range: tuple[_Distance, _Distance] = Field(
        default=(0.3, 10.0), description="nearest and farthest depth that it measures, metres"
    )
    noise: float = Field(default=1.0, ge=0, le=100, description="factor of the random errors; 0: none")
    baseline: float | None = Field(
        default=None,
        gt=0,
        le=2,
        description="distance to the projector, or to the right imager, along its x axis, metres",
    )
    disparity_step: float | None = Field(
        default=None, ge=0, le=1, description="smallest difference of two disparities, pixels; 0: none"
    )
    disparity_noise: float | None = Field(
        default=None, ge=0, le=10, description="standard deviation of the disparity, pixels"
    )
    sigma: Share | None = Field(
        default=None, description="standard deviation on a white surface at 1 m that faces the sensor, metres"
    )
    background: float | None = Field(
        default=None, ge=0, le=100, description="light that is not its own, relative to that surface"
    )
    ambiguity: float | None = Field(
        default=None, ge=0.1, le=1000, description="distance at which distances begin again at 0, metres"
    )
    dark: Share | None = Field(
        default=None,
        description="least light that it measures: reflectivity, or signal relative to that surface",
    )
    grazing_deg: float = Field(
        default=80.0,
        gt=0,
        lt=90,
        description="angle from which on a surface is not seen; 0 faces the sensor, 90 is seen from its edge",
    )
    aligned: bool = Field(
        default=True, description="publish its depth in the pixels of image_raw, and coloured points, too"
    )
    seed: int = Field(default=0, ge=0, description="seed of the random errors")

    @model_validator(mode="before")
    @classmethod
    def _text_alone(cls, value: Any) -> Any:
        """Add the settings of the preset and of the model, except for keys that are given."""
        given = {"preset": value} if isinstance(value, str) else value
        if not isinstance(given, dict):
            return given
        preset, model = (
            given.get(key) if isinstance(given.get(key), str) else None for key in ("preset", "model")
        )
        known = PRESETS.get(preset or "", {})
        if known and model not in (None, known["model"]):
            raise ValueError(f"{preset} is a sensor of model {known['model']}")
        if "K" in given:
            known = {key: part for key, part in known.items() if key != "fov_deg"}
        return {**MODEL_KEYS.get(model or known.get("model", ""), {}), **known, **given}

    @field_validator("range")
    @classmethod
    def _check_range(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] >= value[1]:
            message = f"give the nearest depth, then a farther one, unlike [{value[0]:g}, {value[1]:g}]"
            raise ValueError(message)
        return value

    @model_validator(mode="after")
    def _is_one_model(self) -> DepthSensorConfig:
        if self.model is None:
            raise ValueError(
                f"give a preset ({', '.join(get_args(Preset))}) or a model ({', '.join(get_args(Model))})"
            )
        if self.K is not None and self.fov_deg is not None:
            raise ValueError("the intrinsics are given by fov_deg and by K: give one of them")
        for model, keys in MODEL_KEYS.items():
            for key in keys:
                if key not in MODEL_KEYS[self.model] and getattr(self, key) is not None:
                    raise ValueError(f"{key} goes with {model} only, and this is {self.model}")
        for key, default in MODEL_KEYS[self.model].items():
            if getattr(self, key) is None and default is not None:
                raise ValueError(f"{self.model} needs {key}")
        return self
