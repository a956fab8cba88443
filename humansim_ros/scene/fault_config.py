"""Settings of the faults of a camera in a scene file; without them a camera has none (docs/faults.md)."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import Field, field_validator, model_validator

from humansim_ros.io.schema import Section, Share

#: Longest delay, and longest random event, seconds: the schedule looks back as far.
MAX_DELAY, MAX_EVENT = 5.0, 60.0
_Delay = Annotated[float, Field(ge=0, le=MAX_DELAY)]
_Duration = Annotated[float, Field(gt=0, le=MAX_EVENT)]
_Count = Annotated[int, Field(ge=1, le=1000)]
_Time = Annotated[float, Field(ge=0, le=1e6)]


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
    }

    seed: int = Field(default=0, ge=0, description="the same seed gives the same faults")
    drop: DropFault | None = Field(default=None, description="frames that are lost")
    freeze: FreezeFault | None = Field(default=None, description="the picture stands, stamps go on")
    outage: OutageFault | None = Field(default=None, description="the camera dies and returns")
    late: LateFault | None = Field(default=None, description="images are sent late")
    out_of_order: OutOfOrderFault | None = Field(default=None, description="images are sent after later ones")
    duplicate: DuplicateFault | None = Field(default=None, description="images are sent twice")
    clock: ClockFault | None = Field(default=None, description="wrong stamps of images")
