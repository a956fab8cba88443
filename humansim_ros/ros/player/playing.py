"""How a motion player goes on from frame to frame: its strategies share this interface."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

from humansim_ros.ros.node import SceneNode
from humansim_ros.scene.playback import Playback, PlaybackClock, ScenePoses, Tick

#: Most frames that are requested during a pause and not sent yet.
MAX_WAITING = 100


class FramePlayer(SceneNode):
    """Node whose frames a :class:`Playing` sends.

    Attributes:
        playback: Motions.
        playback_clock: Stamp and scene time of each frame.
        playing: How it goes on from frame to frame.
    """

    playback: Playback
    playback_clock: PlaybackClock
    playing: Playing

    def send_frame(self, tick: Tick, scene_poses: ScenePoses) -> None:
        """Publish one frame."""
        raise NotImplementedError

    def restart(self) -> Tick:
        """Jump to scene time 0; returns the frame that shows it."""
        raise NotImplementedError

    def change_motions(self, changes: Mapping[str, Mapping[str, Any]]) -> None:
        """Change the motions of humans at once.

        ``changes``: keys of a section ``motion`` by human. Raises HumansimError, and changes nothing, if one
        cannot be played.
        """
        raise NotImplementedError

    def restart_legends(self) -> None:
        """Publish legends that are valid for all stamps, because stamps have jumped back."""
        raise NotImplementedError


class Playing(ABC):
    """Sends the frames of a player, one after the other.

    ``player``: the node.
    """

    def __init__(self, player: FramePlayer) -> None:
        self.player = player
        self.clock = player.playback_clock

    @property
    @abstractmethod
    def is_paused(self) -> bool:
        """Whether frames follow only on request."""

    @property
    @abstractmethod
    def waiting(self) -> int:
        """Number of requested frames that are not sent yet."""

    @abstractmethod
    def pause(self, paused: bool) -> None:
        """Pause, or continue."""

    @abstractmethod
    def step(self, frames: int = 1, done: Callable[[], object] | None = None) -> Tick:
        """Play some frames during a pause. At most ``MAX_WAITING`` may wait, see :attr:`waiting`.

        ``done``: called when they are finished.

        Returns:
            The last of these frames.
        """

    @abstractmethod
    def seek(self, seconds: float) -> Tick:
        """Jump to a scene time, as soon as possible; returns the frame that shows it."""

    @abstractmethod
    def follow_rate(self) -> None:
        """Go on after a change of the frames per second."""

    def close(self) -> None:  # noqa: B027
        """End playing."""

    @abstractmethod
    def work(self) -> None:
        """Go on while the executor of the node waits for a callback."""
