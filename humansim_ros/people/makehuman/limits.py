"""Limits of the people that are drawn by seed."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator

from humansim_ros.files.yaml import Section, Share

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
