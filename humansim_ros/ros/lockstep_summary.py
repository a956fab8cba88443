"""Summary of a run in lockstep; imports no ROS."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from humansim_ros.io.files import atomic_path


@dataclass(frozen=True)
class LockstepSummary:
    """Frames of a motion player in lockstep.

    Attributes:
        frames: Number of frames of the run.
        sent: Number of those that this player has sent; others were sent before it was started again.
        finished: Number of frames that each member has finished, of those that this player has sent.
        seconds: Wall-clock time of these.
        scene_seconds: Simulated time of these.
        is_complete: Whether these are all the frames that were requested.
        error: Why it ended early; empty if it did not.
    """

    frames: int
    sent: int
    finished: Mapping[str, int]
    seconds: float
    scene_seconds: float
    is_complete: bool
    error: str = ""

    @property
    def text(self) -> str:
        """Lines for people."""
        seconds = max(self.seconds, 1e-9)
        again = (
            f" ({self.sent} of them since the player was started again)" if self.sent < self.frames else ""
        )
        members = ", ".join(f"{name} {count}" for name, count in self.finished.items())
        return (
            f"{self.frames} frames in lockstep{again}; {self.sent} in {self.seconds:.1f} s: "
            f"{self.sent / seconds:.1f} frames/s, {self.scene_seconds / seconds:.2f} times real time\n"
            f"finished: {members}"
        )

    def write(self, path: str) -> None:
        """Write it to a file."""
        with atomic_path(path) as target:
            target.write_text(json.dumps(asdict(self)))

    @classmethod
    def read(cls, path: Path) -> LockstepSummary | None:
        """Read what :meth:`write` has written; None if there is nothing."""
        return cls(**json.loads(path.read_text())) if path.is_file() else None
