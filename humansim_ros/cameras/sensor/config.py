"""Settings of a sensor in a scene file. By default all effects are off (docs/sensors.md)."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from humansim_ros.files.yaml import Section

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
    corner: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="fraction lost at the farthest corner; proportional to the squared distance",
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
        default=8,
        ge=1,
        le=256,
        description="images rendered for a frame with motion blur or rolling shutter",
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
