"""Settings of the messages for other people stacks in a scene file (docs/people_messages.md)."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from humansim_ros.files.yaml import Expected, Section, ShortSection, TopicName

#: Name of a frame of tf.
_Frame = Annotated[
    str,
    Field(pattern=r"^[A-Za-z_][A-Za-z0-9_/]*$", max_length=255),
    Expected("a frame of tf, such as map"),
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
