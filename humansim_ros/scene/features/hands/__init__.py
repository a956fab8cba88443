"""Key ``hands`` of motions: poses of the hands over time."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from humansim_ros.files.yaml import ShortSection
from humansim_ros.motion.pose import HandKey, HandPoseName, HandSide


class HandKeyConfig(ShortSection):
    """Pose of the hands from a time of the motion on."""

    short_key: ClassVar[str] = "pose"

    pose: HandPoseName = Field(description="name of the hand pose")
    time: float = Field(default=0.0, ge=0, description="start of the change, seconds of the file")
    side: HandSide = Field(default="both", description="the hand")
    blend: float = Field(default=0.3, ge=0, le=1e4, description="duration of the change, seconds of the file")
    over_motion: bool = Field(default=False, description="also move fingers that the motion moves")

    @property
    def key(self) -> HandKey:
        """The key as the motion plays it."""
        return HandKey(self.pose, self.time, self.side, self.blend, self.over_motion)
