"""Keys of hand poses, and the keys of built-in motions. The module imports neither meshes nor motions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

HandPoseName = Literal[
    "relaxed", "fist", "point", "flat", "grip", "wave", "one", "two", "three", "four", "five"
]
HandSide = Literal["left", "right", "both"]
#: Largest time of a key, seconds.
MAX_SECONDS = 1e6


@dataclass(frozen=True)
class HandKey:
    """A pose of a hand from a time on.

    Attributes:
        pose: Name of the pose.
        time: Seconds of the motion file.
        side: The hand, or both.
        blend: From ``time`` on, the hand changes from the pose before to this pose over this time, seconds of
            the file.
        over_motion: Whether the key also moves fingers that the motion moves.
    """

    pose: HandPoseName
    time: float = 0.0
    side: HandSide = "both"
    blend: float = 0.3
    over_motion: bool = False


#: Hand poses for built-in motions in which hands hold something or lie on the floor.
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
