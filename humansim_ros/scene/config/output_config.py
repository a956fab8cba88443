"""Sections ``about`` (docs/datasets.md) and ``adapters`` (docs/people_messages.md) of a scene file."""

from __future__ import annotations

import datetime
from typing import Annotated, ClassVar, Literal

from pydantic import BeforeValidator, Field, StringConstraints, field_validator

from humansim_ros.files.yaml import Expected, Section, ShortSection, TopicName

_Line = Annotated[str, StringConstraints(min_length=1, max_length=2000)]


class AboutConfig(Section):
    """What a data card says of a data set: section ``about`` of a scene and of a recipe."""

    title: _Line | None = Field(default=None, description="title; the name of the file or recipe if absent")
    description: _Line | None = Field(default=None, description="what the data set is for")
    creators: tuple[_Line, ...] = Field(default=(), max_length=100, description="people or organisations")
    citation: _Line | None = Field(default=None, description="how to cite it, as text or BibTeX")
    date: (
        Annotated[
            str,
            BeforeValidator(lambda value: value.isoformat() if isinstance(value, datetime.date) else value),
            StringConstraints(pattern=r"^\d{4}-\d{2}-\d{2}$"),
            Expected("a date, such as 2026-11-28"),
        ]
        | None
    ) = Field(default=None, description="date of publication")
    version: Annotated[
        str,
        StringConstraints(pattern=r"^\d+\.\d+\.\d+$"),
        Expected("a text with three numbers, such as 1.0.0"),
    ] = Field(default="1.0.0", description="version of the data set")
    url: (
        Annotated[
            str,
            StringConstraints(pattern=r"^https?://\S+$", max_length=2000),
            Expected("an address, such as https://example.org"),
        ]
        | None
    ) = Field(default=None, description="address of its page")

    @field_validator("date")
    @classmethod
    def _is_a_day(cls, date: str | None) -> str | None:
        if date is not None:
            datetime.date.fromisoformat(date)
        return date


#: Name of a frame of tf.
_Frame = Annotated[
    str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_/]*$", max_length=255), Expected("a frame of tf, such as map")
]


class FramedConfig(ShortSection):
    """Messages of people in a frame of tf."""

    short_key: ClassVar[str] = "frame"

    frame: _Frame = Field(
        default="map", description="frame of the numbers: map, of a camera or scanner, or of the robot"
    )
    topic: TopicName | None = Field(default=None, description="topic in place of the usual one")


class TrackedConfig(FramedConfig):
    """Tracks of people."""

    camera: str | None = Field(
        default=None, description="camera that sees the people: others are occluded; none if absent"
    )


class BoxesConfig(Section):
    """Boxes of people in images."""

    cameras: tuple[str, ...] | None = Field(
        default=None, min_length=1, description="names of the cameras; all if absent"
    )
    box: Literal["visible", "whole"] = Field(
        default="visible", description="box of the visible pixels, or of the whole body"
    )
    topic: TopicName | None = Field(
        default=None, description="topic below the name of the camera in place of the usual one"
    )


class HriConfig(ShortSection):
    """People as a camera sees them, for ROS4HRI."""

    short_key: ClassVar[str] = "camera"

    camera: str = Field(description="camera that sees the people")


class AdaptersConfig(Section):
    """Messages for other people stacks; a key for each row of the table of adapters but ``hri``."""

    detections_2d: BoxesConfig | None = Field(default=None, description="vision_msgs/Detection2DArray")
    detections_3d: FramedConfig | None = Field(default=None, description="vision_msgs/Detection3DArray")
    people: FramedConfig | None = Field(default=None, description="people_msgs/People")
    tracked_persons: TrackedConfig | None = Field(
        default=None, description="spencer_tracking_msgs/TrackedPersons"
    )
