"""Key ``held_by`` of the objects of a scene file."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, model_validator

from humansim_ros.files.yaml import ShortSection


class HoldConfig(ShortSection):
    """A human who takes an object along: in two hands, or on the path."""

    short_key: ClassVar[str] = "human"

    human: str = Field(description="name of the human who holds it")
    by: Literal["hands", "path"] = Field(
        default="hands",
        description="hands: it is between the palms; path: it goes along on the floor, as a cart does, in a "
        "frame below the hips (x ahead, y left, z up)",
    )
    start: float = Field(
        default=0.0, ge=0, description="when the hands take it, seconds of the motion; before it stays there"
    )
    end: float | None = Field(
        default=None,
        gt=0,
        description="when the hands leave it, seconds of the motion; never if absent. After it stays there",
    )

    @model_validator(mode="after")
    def _is_in_order(self) -> HoldConfig:
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"end ({self.end:g} s) must come after start ({self.start:g} s)")
        return self
