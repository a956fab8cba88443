"""Interface of the two ways in which a motion player advances from frame to frame: lockstep and real time."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.parameter import Parameter

from humansim_ros.errors import RosError
from humansim_ros.ros.graph.graph import StampedTopics
from humansim_ros.ros.playing.clock import PlaybackClock, Tick
from humansim_ros.ros.processes.lockstep_settings import topic_name
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.scene.core import Playback, SceneState

#: Most frames that requests during a pause may have waiting.
MAX_WAITING = 100
#: Seconds between two checks of ``step_topic``; and smallest and largest ``step_timeout``, seconds.
_LOOK_EVERY, _LIMITS = 0.05, (0.1, 3600.0)


class FramePlayer(SceneNode):
    """Base class of the motion player: a node with frames, which a :class:`Playing` decides to send.

    Attributes:
        playback: Motions of all humans.
        playback_clock: Stamp and scene time of each frame.
        playing: Strategy that sends the frames.
        stamped_steps: Steps that end when a message with their stamp arrives.
    """

    playback: Playback
    playback_clock: PlaybackClock
    playing: Playing
    stamped_steps: StampedSteps

    def send_frame(self, tick: Tick, shown: SceneState) -> None:
        """Publish the messages of one frame."""
        raise NotImplementedError

    def restart(self) -> Tick:
        """Jump to scene time 0. Returns the frame that shows this time."""
        raise NotImplementedError

    def change_motions(self, changes: Mapping[str, Mapping[str, Any]]) -> None:
        """Change the motions of several humans at once. ``changes``: keys of a section ``motion`` by human.
        If one cannot be played, changes nothing and raises HumansimError."""
        raise NotImplementedError

    def restart_legends(self) -> None:
        """Publish the legends again, valid for all stamps, because stamps have jumped back."""
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
        """Whether frames are sent only on request."""

    @property
    @abstractmethod
    def waiting(self) -> int:
        """Number of requested frames that are not sent yet."""

    @abstractmethod
    def pause(self, paused: bool) -> None:
        """Pause, or continue."""

    @abstractmethod
    def step(self, done: Callable[[], object] | None = None) -> Tick:
        """Play a frame during a pause, and return it. At most ``MAX_WAITING`` may wait (see :attr:`waiting`).

        ``done``: called when the frame is finished.
        """

    @abstractmethod
    def seek(self, seconds: float) -> Tick:
        """Jump to a scene time as soon as possible. Returns the frame that shows this time."""

    @abstractmethod
    def follow_rate(self) -> None:
        """React to a change of the frames per second."""

    def report(self, stamp: int) -> None:  # noqa: B027
        """Note that the player has received odometry of another node with this stamp, nanoseconds."""

    def close(self) -> None:  # noqa: B027
        """Send no more frames."""

    @abstractmethod
    def work(self) -> None:
        """Work while the executor of the node waits for a callback."""


@dataclass
class _Step:
    """A step that has not been answered yet.

    Attributes:
        done: Called at the end of the step with its frame (or None), and the reason if it failed.
        deadline: Monotonic seconds at which the step fails.
        tick: The frame, as soon as it is requested.
        is_played: Whether the player has finished the frame.
        has_message: Whether a message with the stamp of the frame has arrived.
    """

    done: Callable[[Tick | None, str], object]
    deadline: float
    tick: Tick | None = None
    is_played: bool = False
    has_message: bool = False


class StampedSteps:
    """Plays steps during a pause. A step ends when a message with the stamp of its frame arrives on a topic.

    Parameters of the player, which may be set at any time: ``step_topic`` is the topic, such as the output of
    a tracker. If it is empty, steps do not wait. ``step_timeout`` is the time until a step fails, seconds.

    Args:
        player: The node.

    Raises:
        RosError: ``step_topic`` is no name of a topic.
    """

    def __init__(self, player: FramePlayer) -> None:
        self._player = player
        description = "A step ends when a message with its stamp is on this topic; empty: when it is sent"
        self.topic = _checked(player.described_parameter("step_topic", "", description))
        description = "Seconds after which a step fails whose message has not arrived"
        self._timeout = float(player.described_parameter("step_timeout", 10.0, description, _LIMITS))
        self._step: _Step | None = None
        #: Newest stamp on the topic, nanoseconds; None before the first message.
        self._newest: int | None = None
        self._topics = StampedTopics(player, [self.topic] if self.topic else [], self._on_stamp)
        player.add_on_set_parameters_callback(_check)
        player.add_post_set_parameters_callback(self._apply)
        self._timer = player.create_timer(
            _LOOK_EVERY, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self._timer.cancel()
        if self.topic:
            self._timer.reset()

    def play(self, done: Callable[[Tick | None, str], object]) -> None:
        """During a pause, play a frame as soon as the topic has a publisher, and wait for a message with its
        stamp.

        ``done``: called once, with the frame (None if none was played), and the reason if the step failed.

        Raises:
            RosError: Another step is not finished.
        """
        if self._step is not None:
            raise RosError(f"another step waits for {self.topic}: call it again after its answer")
        self._step = _Step(done, time.monotonic() + self._timeout)
        self._look()

    def cancel(self, reason: str, done: Callable[[Tick | None, str], object] | None = None) -> None:
        """End the unfinished step, if any; with ``done``, only one that was played with this ``done``."""
        if (step := self._step) is not None and done in (None, step.done):
            self._step = None
            step.done(step.tick, reason)

    def _look(self) -> None:
        """Check the topic. Then subscribe to the topic, send the frame of a step, or end the step."""
        step = self._step
        try:
            self._topics.update()
        except RosError as error:
            self.cancel(f"step_topic {error}")
            return
        if step is None:
            return
        if time.monotonic() >= step.deadline:
            self.cancel(self._failure(step))
        elif step.tick is None and self._topics.is_connected(self.topic):
            step.tick = self._player.playing.step(lambda: self._on_played(step))

    def _failure(self, step: _Step) -> str:
        limit = f"within {self._timeout:g} s (step_timeout)"
        if step.tick is None:
            return f"no frame was played: nobody publishes {self.topic} {limit}"
        if not step.is_played:
            return f"frame {_seconds(step.tick.stamp)} was not finished {limit}"
        newest = "no message" if self._newest is None else f"newest stamp there: {_seconds(self._newest)}"
        return f"no message with stamp {_seconds(step.tick.stamp)} on {self.topic} {limit}; {newest}"

    def _on_stamp(self, _: str, stamp: int) -> None:
        self._newest = stamp if self._newest is None else max(self._newest, stamp)
        if (step := self._step) is not None and step.tick is not None and stamp == step.tick.stamp:
            step.has_message = True
            self._end_if_done(step)

    def _on_played(self, step: _Step) -> None:
        step.is_played = True
        self._end_if_done(step)

    def _end_if_done(self, step: _Step) -> None:
        if step is self._step and step.is_played and step.has_message:
            self.cancel("")

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        values = {parameter.name: parameter.value for parameter in parameters}
        self._timeout = values.get("step_timeout", self._timeout)
        topic = values.get("step_topic", self.topic)
        if topic == self.topic:
            return
        self.cancel("step_topic was changed")
        self._topics.close()
        self.topic, self._newest = topic, None
        self._topics = StampedTopics(self._player, [topic] if topic else [], self._on_stamp)
        (self._timer.reset if topic else self._timer.cancel)()


def _checked(topic: str) -> str:
    """Return the value of ``step_topic``. Raises RosError if it is not empty and no name of a topic."""
    return topic_name("step_topic", topic) if topic else ""


def _check(parameters: Sequence[Parameter]) -> SetParametersResult:
    """Refuse a ``step_topic`` that is no valid name, since it comes over the network."""
    try:
        for parameter in parameters:
            if parameter.name == "step_topic" and isinstance(parameter.value, str):
                _checked(parameter.value)
    except RosError as error:
        return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)


def _seconds(stamp: int) -> str:
    """A stamp as text: seconds with nine decimals."""
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"
