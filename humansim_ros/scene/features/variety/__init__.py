"""Section ``variety`` of a scene file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from humansim_ros.files.yaml import FileName, SceneName, Section, Share
from humansim_ros.scene.config.camera_config import Area

_Age = Annotated[float, Field(ge=2, le=90)]
_Stature = Annotated[float, Field(ge=0.6, le=2.3)]
_Bmi = Annotated[float, Field(ge=12, le=42)]
_Tone = Annotated[int, Field(ge=1, le=10)]


class PeopleConfig(Section):
    """People drawn by seed from surveys (docs/humans.md)."""

    age: tuple[_Age, _Age] = Field(default=(2.0, 90.0), description="youngest and oldest age, years")
    women: Share = Field(default=0.5, description="share of women and girls")
    stature: tuple[_Stature, _Stature] = Field(
        default=(0.6, 2.3), description="least and greatest stature barefoot, metres"
    )
    bmi: tuple[_Bmi, _Bmi] = Field(
        default=(12.0, 42.0), description="least and greatest body mass index, kg/m²"
    )
    skin: tuple[_Tone, _Tone] = Field(
        default=(1, 10), description="first and last skin tone of the Monk scale"
    )
    uniform: bool = Field(default=False, description="all wear clothes of the same cut, colours and fabrics")

    @field_validator("age", "stature", "bmi", "skin")
    @classmethod
    def _rising(cls, limits: tuple[float, float]) -> tuple[float, float]:
        if limits[0] > limits[1]:
            raise ValueError(f"the first number, {limits[0]:g}, is above the second, {limits[1]:g}")
        return limits


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
