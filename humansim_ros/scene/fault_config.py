"""Settings of the faults of a camera in a scene file; without them a camera has none (docs/faults.md)."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import Field, GetJsonSchemaHandler, field_validator, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from humansim_ros.io.schema import Section, Share

#: Longest delay, and longest random event, seconds: the schedule looks back as far.
MAX_DELAY, MAX_EVENT = 5.0, 60.0
#: Longest time, seconds, over which bodies are moved at the velocities of their frame.
MAX_TRIGGER_DELAY = 0.1
_Delay = Annotated[float, Field(ge=0, le=MAX_DELAY)]
_Duration = Annotated[float, Field(gt=0, le=MAX_EVENT)]
_Count = Annotated[int, Field(ge=1, le=1000)]
_Time = Annotated[float, Field(ge=0, le=1e6)]
_Stops = Annotated[float, Field(ge=-10, le=10)]
_SpotSize = Annotated[float, Field(gt=0, le=2)]
#: Parts of the JSON schema of a key that say nothing about its values.
_OF_KEYS = ("default", "description", "title")


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError(f"give the smaller number first: [{value[1]:g}, {value[0]:g}]")
    return value


class _NumberSection(Section):
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


class DropFault(_NumberSection):
    """Frames that are lost."""

    probability: Share = Field(description="probability that a loss begins at a frame")
    frames: tuple[_Count, _Count] = Field(
        default=(1, 1), description="least and greatest number of frames that are lost together"
    )

    _check_frames = field_validator("frames")(_ordered)


class _EventFault(_NumberSection):
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

    other_words: ClassVar[dict[str, str]] = {"delay": "latency time"}

    probability: Share = Field(default=1.0, description="probability that a frame is delayed")
    delay: tuple[_Delay, _Delay] = Field(
        examples=[[0.05, 0.1]], description="least and greatest delay, seconds"
    )

    _check_delay = field_validator("delay")(_ordered)


class OutOfOrderFault(_NumberSection):
    """Images that are sent after later ones."""

    probability: Share = Field(description="probability that a frame is held back")
    frames: Annotated[int, Field(ge=1, le=100)] = Field(
        default=1, description="number of later frames that are sent before it"
    )


class DuplicateFault(_NumberSection):
    """Images that are sent twice."""

    probability: Share = Field(description="probability that a frame is sent twice")


class ClockFault(_NumberSection):
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


class TriggerDelayFault(_NumberSection):
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

    other_words: ClassVar[dict[str, str]] = {
        "rotation": "angle deg degrees turn",
        "translation": "offset position metres",
        "focal": "focal_length zoom f",
    }

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

    other_words: ClassVar[dict[str, str]] = {"depth": "amplitude strength", "frequency": "hz rate"}

    frequency: float = Field(
        gt=0, le=1e5, examples=[100], description="maxima of the light per second; mains have 100 or 120"
    )
    depth: Share = Field(
        default=0.5, description="(brightest - darkest) / (brightest + darkest) of the light"
    )


class ExposureStepsFault(_NumberSection):
    """The exposure steps, as that of an automatic exposure does."""

    probability: Share = Field(description="probability that the exposure steps at a frame")
    stops: tuple[_Stops, _Stops] = Field(
        default=(-1.0, 1.0), description="least and greatest exposure after a step, in stops"
    )

    _check_stops = field_validator("stops")(_ordered)


class DirtFault(_NumberSection):
    """Spots on the lens, out of focus."""

    number_key: ClassVar[str] = "spots"
    other_words: ClassVar[dict[str, str]] = {"spots": "count number", "size": "diameter radius"}

    spots: _Count = Field(description="number of spots")
    size: tuple[_SpotSize, _SpotSize] = Field(
        default=(0.03, 0.12), description="least and greatest diameter, as a share of the image width"
    )
    opacity: Share = Field(default=0.7, description="light that the middle of a spot takes, as a share")

    _check_size = field_validator("size")(_ordered)


class FaultsConfig(Section):
    """Faults of a camera."""

    other_words: ClassVar[dict[str, str]] = {
        "drop": "drops dropped loss lost",
        "freeze": "frozen stuck",
        "outage": "outages dead dies",
        "late": "delay latency",
        "out_of_order": "reorder order swap",
        "duplicate": "duplicates twice repeat",
        "clock": "stamp time_offset",
        "trigger_delay": "trigger sync triggered_late",
        "calibration": "extrinsics intrinsics miscalibration",
        "flicker": "lamp mains light",
        "exposure_steps": "exposure auto_exposure",
        "dirt": "dust smudge spots",
    }

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
