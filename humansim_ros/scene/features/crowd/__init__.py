"""Section ``crowd`` of a scene file."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, model_validator

from humansim_ros.files.yaml import FileName, SceneName, Section
from humansim_ros.scene.config.camera_config import Area, Bounded


class FlowConfig(Section):
    """People who walk from an area to another one, and back."""

    start: Area = Field(description="area that they come from: x, y of two corners")
    goal: Area = Field(description="area that they walk to: x, y of two corners")
    share: float = Field(default=1.0, gt=0, le=1e6, description="how many, relative to the other flows")


class QueueConfig(Section):
    """People who stand in line; the first one is served, and walks back to the end of the line."""

    position: tuple[Bounded, Bounded] = Field(description="place of the first one: x, y in map, metres")
    direction_deg: float = Field(
        default=0.0, description="direction from the first to the last one, degrees from +x to the left"
    )
    count: int = Field(ge=1, le=1000, description="number of people in line")
    spacing: float = Field(default=0.8, ge=0.5, le=10, description="metres from one to the next")
    service: float = Field(default=5.0, ge=0, le=1e4, description="seconds that one is served")


class CrowdConfig(Section):
    """People who walk among each other without touching (docs/crowds.md)."""

    count: int = Field(ge=0, le=1000, description="number of people")
    seed: int = Field(default=1, ge=0, description="the same seed gives the same crowd")
    name: SceneName = Field(default="walker", description="prefix of their names: walker_1, walker_2 …")
    bodies: tuple[FileName, ...] | None = Field(
        default=None, min_length=1, description="bodies to choose from; the built-in humans if absent"
    )
    motions: tuple[FileName, ...] = Field(
        default=("walk_straight",),
        min_length=1,
        description="motions to choose from, which walk straight ahead",
    )
    area: Area | None = Field(
        default=None,
        description="floor of the crowd: x, y of two corners; the room if absent, or 10 x 10 m without one",
    )
    alive: bool = Field(default=False, description="give them faces that blink and glance around")
    flows: tuple[FlowConfig, ...] = Field(
        default=(), max_length=100, description="where they walk; to places at random in the area if absent"
    )
    groups: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="share of the people who walk in groups of two to four, side by side",
    )
    queues: tuple[QueueConfig, ...] = Field(
        default=(), max_length=100, description="lines in which some stand"
    )
    speed: tuple[Annotated[float, Field(ge=0.2, le=2.0)], Annotated[float, Field(ge=0, le=1)]] = Field(
        default=(1.34, 0.26), description="mean and standard deviation of their speeds, m/s [Weidmann 1993]"
    )
    pause: tuple[Annotated[float, Field(ge=0, le=1e4)], Annotated[float, Field(ge=0, le=1e4)]] = Field(
        default=(0.0, 2.0), description="shortest and longest stay at a goal, seconds"
    )
    radius: float = Field(
        default=0.3,
        ge=0.15,
        le=1.0,
        description="radius of a person seen from above, metres: the middles of two people keep twice as far",
    )
    duration: float = Field(
        default=60.0,
        ge=10,
        le=3600,
        description="seconds after which everybody is back at the start and the crowd repeats",
    )

    @model_validator(mode="after")
    def _has_room_in_queues(self) -> CrowdConfig:
        for queue in self.queues:
            if queue.spacing < 2 * self.radius:
                raise ValueError(
                    f"a radius of {self.radius:g} m needs a spacing of {2 * self.radius:g} m in queues"
                )
        return self
