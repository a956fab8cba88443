"""Section ``room`` of a scene file."""

from __future__ import annotations

from pydantic import Field, model_validator

from humansim_ros.files.yaml import Section


class RoomConfig(Section):
    """The furnished room."""

    size: tuple[float, float, float] = Field(
        default=(7.0, 6.4, 2.8), description="length along x, width along y, height; metres"
    )
    seed: int = Field(default=1, ge=0, description="the same seed gives the same room")

    @model_validator(mode="after")
    def _big_enough(self) -> RoomConfig:
        if min(self.size[:2]) < 5.0 or max(self.size) > 100 or self.size[2] < 2.2:
            raise ValueError("the furniture needs a room of at least 5 x 5 x 2.2 m (and at most 100 m)")
        return self
