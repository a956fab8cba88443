"""What is said of the data sets of a scene: title, authors, citation, date."""

from __future__ import annotations

import datetime
from typing import Annotated

from pydantic import BeforeValidator, Field, StringConstraints, field_validator

from humansim_ros.files.yaml import Expected, Section

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
