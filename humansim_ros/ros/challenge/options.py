"""Options of a challenge. The module loads fast, since the command line has them as options."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class ChallengeOptions:
    """How a tracker is run: options of ``humansim challenge``, with help texts, limits and units in
    config/command_line.json.

    Without a keypoint set, the joint names in the messages decide; without axes, those of ``map`` are meant.
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
