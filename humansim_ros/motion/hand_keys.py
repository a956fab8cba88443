"""Keys of hand poses, and those of built-in motions; imports neither meshes nor motions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

HandPoseName = Literal[
    "relaxed", "fist", "point", "flat", "grip", "wave", "one", "two", "three", "four", "five"
]
HandSide = Literal["left", "right", "both"]
#: Most seconds of a key.
MAX_SECONDS = 1e6


@dataclass(frozen=True)
class HandKey:
    """A pose of a hand from a time on.

    Attributes:
        pose: Name of the pose.
        time: Seconds of the motion file.
        side: The hand, or both.
        blend: Seconds of the file over which the hand changes from the pose before, from ``time`` on.
        over_motion: Also move fingers that the motion moves.
    """

    pose: HandPoseName
    time: float = 0.0
    side: HandSide = "both"
    blend: float = 0.3
    over_motion: bool = False


#: Hands of built-in motions that hold something, or lie on the floor.
BUILT_IN_HANDS: Mapping[str, tuple[HandKey, ...]] = {
    "pick_up": (
        HandKey("relaxed", 0.0, "right"),
        HandKey("grip", 2.2, "right", 0.5),
        HandKey("relaxed", 5.2, "right", 0.6),
    ),
    "phone": (HandKey("grip", 0.0, "right"),),
    "write": (HandKey("grip", 0.0, "right"),),
    "eat": (HandKey("grip", 0.0, "right"),),
    "crawl": (HandKey("flat"),),
}
