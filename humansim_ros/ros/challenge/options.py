"""Options of a challenge. The module loads fast, since the command line has them as options."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class ChallengeOptions:
    """How a tracker is run.

    Attributes:
        tracker: Command line that starts the tracker.
        topic: Topic of the estimate.
        keypoints: Keypoint set of the estimate. If None, the joint names in its messages determine the set.
        timeout: Seconds that a frame waits for the tracker.
        start_within: The tracker must publish its topic within this time, seconds.
        is_realtime: Whether frames follow the wall clock.
        is_quick: Whether the short form of the suite is run.
        scale: Length of a unit of the estimate, metres.
        axes: Axes of the estimate. If None, the axes of ``map``.
    """

    tracker: str
    topic: str = "/tracker/poses"
    keypoints: str | None = None
    timeout: float = 10.0
    start_within: float = 20.0
    is_realtime: bool = False
    is_quick: bool = False
    scale: float = 1.0
    axes: str | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """All options except the command line. Options of newer versions are left out if they are
        defaults."""
        added = {"scale": 1.0, "axes": None}
        values = {key: value for key, value in asdict(self).items() if key != "tracker"}
        return {key: value for key, value in values.items() if key not in added or value != added[key]}
