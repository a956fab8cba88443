"""Key ``reach`` of the humans of a scene file."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field, model_validator

from humansim_ros.files.yaml import Section
from humansim_ros.motion.pose import HandPoseName
from humansim_ros.scene.config.camera_config import BoundedVector3


class ReachConfig(Section):
    """A hand that goes to something, stays there, and goes back."""

    hand: Literal["left", "right"] = Field(default="right", description="the hand")
    to: BoundedVector3 | str = Field(
        description="a point in map, the name of an object, or of a human: without at one who reaches for "
        "this one, so that their palms meet"
    )
    at: BoundedVector3 | str | None = Field(
        default=None,
        description="place that the palm touches: of an object a point in its own axes, metres from its "
        "origin (0 0 0 if absent); of a human the name of a joint",
    )
    start: float = Field(
        default=0.0, ge=0, le=1e6, description="when the hand leaves the motion, seconds of the scene"
    )
    end: float | None = Field(
        default=None, gt=0, le=1e6, description="when it is back, seconds of the scene; never if absent"
    )
    repeat: float | None = Field(
        default=None, gt=0, le=1e6, description="seconds after which it begins again; once if absent"
    )
    blend: float = Field(
        default=0.8, ge=0, le=1e4, description="time of the way there, and of the way back, seconds"
    )
    palm: BoundedVector3 | None = Field(
        default=None,
        description="direction that the palm faces, in map or in the axes of the object; if absent, as the "
        "forearm turns it",
    )
    fingers: BoundedVector3 | None = Field(
        default=None,
        description="direction of the fingers, in map or in the axes of the object; if absent, along the "
        "forearm, or up where the palm allows it",
    )
    pose: HandPoseName | None = Field(
        default=None,
        description="pose of the hand while it is there, such as grip; of motion.hands if absent",
    )
    shake: float = Field(
        default=0.03, ge=0, le=0.2, description="metres by which right hands, or left ones, that meet shake"
    )

    @property
    def until(self) -> float:
        """End, seconds; infinite without."""
        return math.inf if self.end is None else self.end

    @property
    def span(self) -> str:
        """Start and end for messages."""
        return f"{self.start:g} s on" if self.end is None else f"{self.start:g} to {self.end:g} s"

    @model_validator(mode="after")
    def _is_possible(self) -> ReachConfig:
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"end ({self.end:g} s) must come after start ({self.start:g} s)")
        if self.until - self.start < 2 * self.blend:
            raise ValueError(
                f"from {self.span} there is no time for the way there and back, of {self.blend:g} s each: "
                "give a later end, or a shorter blend"
            )
        if self.repeat is not None and self.until - self.start > self.repeat:
            raise ValueError(
                f"what lasts from {self.span} cannot begin again after {self.repeat:g} s: give an end and a "
                "longer repeat"
            )
        for name, line in (("palm", self.palm), ("fingers", self.fingers)):
            if line is not None and not math.hypot(*line) > 1e-6:
                raise ValueError(f"{name} is a direction: it must not be 0 0 0")
        if self.palm is not None and self.fingers is not None:
            cosine = sum(a * b for a, b in zip(self.palm, self.fingers, strict=True))
            if abs(cosine) > 0.99 * math.hypot(*self.palm) * math.hypot(*self.fingers):
                raise ValueError("palm and fingers must not be parallel: fingers point across the palm")
        return self
