"""Section ``variety`` of a scene file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from humansim_ros.files.yaml import FileName, SceneName, Section
from humansim_ros.people.makehuman import PeopleConfig
from humansim_ros.scene.config.camera_config import Area


class VarietyConfig(Section):
    """Random humans from a seed."""

    count: int = Field(ge=0, le=1000, description="number of humans")
    seed: int = Field(default=1, ge=0, description="the same seed gives the same humans")
    name: SceneName = Field(default="person", description="prefix of their names: person_1, person_2 …")
    bodies: tuple[FileName, ...] | None = Field(
        default=None, min_length=1, description="bodies to choose from; the built-in humans if absent"
    )
    people: PeopleConfig | None = Field(
        default=None, description="draw another person each time, instead of one of the bodies"
    )
    motions: tuple[FileName, ...] | None = Field(
        default=None,
        min_length=1,
        description="motions to choose from; built-in motions if absent. activity: one of its own for each",
    )
    area: Area | None = Field(
        default=None,
        description="area of the middles of their paths: x, y of two corners; the middle of the room if "
        "absent",
    )
    spacing: float = Field(
        default=0.9, ge=0, le=100, description="least distance between the middles of two paths, metres"
    )
    seats: Literal["own", "scene"] = Field(
        default="own",
        description="own: a chair is put below each who sits; scene: they take free chairs of the scene and "
        "the sofa of the room first",
    )
    alive: bool = Field(default=False, description="give them faces that blink and glance around")
    speed: tuple[Annotated[float, Field(gt=0, le=10)], Annotated[float, Field(gt=0, le=10)]] = Field(
        default=(0.9, 1.1), description="least and greatest factor of the motion's speed"
    )

    @model_validator(mode="after")
    def _bodies_or_people(self) -> VarietyConfig:
        if self.people is not None and self.bodies is not None:
            raise ValueError("give bodies to choose from, or people to draw, not both")
        return self
