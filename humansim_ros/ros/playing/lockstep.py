"""Playing in lockstep: a frame is sent when all members (nodes, topics) have finished the previous one."""

from __future__ import annotations

import copy
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from rclpy.clock import Clock as RosClock
from rclpy.clock_type import ClockType
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header

from humansim_ros.data.messages import to_nanoseconds, to_time
from humansim_ros.errors import MAX_FRAMES, RosError, printable
from humansim_ros.ros.graph.clock import ClockOwner
from humansim_ros.ros.graph.graph import GraphWatch, StampedTopics, publishers_of
from humansim_ros.ros.graph.qos import ALIVE, CAMERA_ALIVE, FRAME_DONE, REPORTS
from humansim_ros.ros.playing.clock import Tick
from humansim_ros.ros.playing.playing import FramePlayer, Playing
from humansim_ros.ros.processes.lockstep_rules import (
    Lockstep,
    LockstepSummary,
    Member,
    OnTimeout,
    ProgressFile,
    RestartFile,
)
from humansim_ros.ros.processes.lockstep_settings import (
    CLOCK_SEARCH,
    REALTIME,
    TEST_NODE,
    member_texts,
    read_members,
)
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.ros.processes.run_options import run_row
from humansim_ros.ros.processes.stop_signals import TIMED_OUT, WRONG_INPUT
from humansim_ros.scene.core import BRIDGE_NODE, LOCKSTEP, Scene, SceneState

#: Seconds between two checks of the members.
_LOOK_EVERY = 0.05
#: Seconds between two checks of the graph while a frame is unfinished, and seconds until the first check.
_GRAPH_EVERY, _GRAPH_AFTER = 0.25, 0.3
#: Longest time between two checks that counts, seconds, since members are not late if the player itself was
#: stopped.
_MAX_STEP = 0.5
#: Largest stamp that lockstep can have, nanoseconds (eleven days). Larger ones come from an earlier run in
#: real time.
_MAX_STAMP = 10**15
#: Quality of service of ``/clock``.
_CLOCK_QUEUE = QoSProfile(depth=10)
#: Most characters of a list of names in a log line.
_MAX_TEXT = 500


@dataclass(frozen=True)
class LockstepSettings:
    """Settings of a motion player in lockstep.

    Attributes:
        names: Nodes that frames wait for, and that report on ``frame_done``.
        topics: Topics that frames wait for: a message with the stamp of the frame is a report.
        timeout: Seconds after which a frame waits no longer.
        on_timeout: What happens after this time: ``stop`` or ``continue``.
        pace: Most frames per second of the wall clock. If 0, as fast as possible.
        frames: Number of frames. If 0, without end.
        summary: File for a summary as JSON at the end. If empty, no summary.
        recorder: Name of the recorder, which is among ``names`` and starts with the scene. Empty without one.
        clock_search: Time of the search for another publisher of ``/clock`` before the first frame, seconds.
    """

    names: tuple[str, ...]
    topics: tuple[str, ...]
    timeout: float
    on_timeout: OnTimeout
    pace: float
    frames: int
    summary: str
    recorder: str = ""
    clock_search: float = CLOCK_SEARCH

    @classmethod
    def of_parameters(cls, node: SceneNode) -> LockstepSettings | None:
        """Declare the parameters of lockstep. Returns None if the mode is realtime.

        Raises:
            RosError: A value is not valid.
        """
        time = node.scene.config.time
        helps = {
            name: run_row(name)["help"] for name in ("wait_for", "timeout", "on_timeout", "pace", "frames")
        }
        mode = node.choice_parameter("mode", time.mode, (REALTIME, LOCKSTEP), "Real time, or lockstep")
        default = member_texts(time) or Parameter.Type.STRING_ARRAY
        declare = node.described_parameter
        members: Sequence[str] = declare("wait_for", default, helps["wait_for"], read_only=True) or ()
        low, high = run_row("timeout")["min"], run_row("timeout")["max"]
        timeout = node.number_parameter("timeout", time.timeout, low, high, helps["timeout"])
        on_timeout = node.choice_parameter(
            "on_timeout", time.on_timeout, get_args(OnTimeout), helps["on_timeout"]
        )
        highest, description = run_row("pace")["max"], f"{helps['pace']} 0 counts as absent."
        pace = node.number_parameter("pace", time.rate or 0.0, 0.0, highest, description)
        description = f"{helps['frames']} 0 counts as absent."
        frames = declare("frames", time.frames or 0, description, (0, MAX_FRAMES), read_only=True)
        summary = node.text_parameter("summary", "", "JSON file for a summary of lockstep; empty: none")
        recorder = node.text_parameter("recorder", "", "Recorder that frames wait for; empty: none")
        description = "Seconds in which another publisher of /clock is looked for before the first frame"
        search = node.number_parameter("clock_search", CLOCK_SEARCH, 0.0, 60.0, description)
        names, topics = read_members([*members, recorder] if recorder else members)
        if mode != LOCKSTEP:
            return None
        after: OnTimeout = "stop" if on_timeout == "stop" else "continue"
        return cls(names, topics, timeout, after, pace, frames, summary, recorder, search)


def _finishing(scene: Scene) -> list[str]:
    """Names of the nodes of a scene that report each frame as finished."""
    return [*scene.cameras, *scene.scanners, *([BRIDGE_NODE] if scene.config.adapter_settings else [])]


class LockstepPlaying(Playing):
    """Sends ``/clock``, then the frame, and waits until all members have finished it.

    The members are the cameras and scanners of the scene, its bridge, the names and topics of ``wait_for``,
    and every node that reports on ``frame_done``. A frame is sent at least once. The same stamp is sent again
    for nodes that have joined. A player that is started again goes on with the frame that was in flight.
    Without a file for the summary, the player goes on with the newest frame that a camera has finished.

    Args:
        player: The node.
        settings: Members, time-out, pace and number of frames.
    """

    def __init__(self, player: FramePlayer, settings: LockstepSettings) -> None:
        super().__init__(player)
        self._settings = settings
        self._last_look = time.monotonic()
        self._now = 0.0
        nodes = _finishing(player.scene)
        names = [*nodes, *(self._name(each) for each in settings.names), *settings.topics]
        starting = [*nodes, settings.recorder] if settings.recorder else nodes
        self.state = Lockstep(dict.fromkeys(names), starting, settings.timeout, 0.0)
        self._graph = GraphWatch(player)
        self._next_graph = 0.0
        robot = player.scene.robot
        own = None if robot is None else robot.config.odometry
        odometry = own and player.resolve_topic_name(own)
        #: Those topics of ``wait_for`` that move the robot: a message is a report once the robot has the
        #: pose.
        self._odometry = [name for name in settings.topics if player.resolve_topic_name(name) == odometry]
        others = [name for name in settings.topics if name not in self._odometry]
        self._topics = StampedTopics(player, others, self._on_report)
        #: Ids of the publishers on ``frame_done``, by name of a member that has joined.
        self._reporters: dict[str, set[bytes]] = {}
        self._is_paused = False
        #: Frames to play during a pause, each as the callback after the frame (or None).
        self._steps: deque[Callable[[], object] | None] = deque()
        self._done: Callable[[], object] | None = None
        #: Frame in flight (not finished by all members); and next frame, with the version of its motions.
        self._frame: tuple[Tick, SceneState] | None = None
        self._prepared: tuple[Tick, int, SceneState] | None = None
        #: Number of frames of the run before this player was started.
        self._before = 0
        self._seconds = (0.0, 0.0)
        self._is_over = False
        self._is_due = True
        steady = RosClock(clock_type=ClockType.STEADY_TIME)
        #: File with the stamp from which a restarted player goes on. If None, cameras report this stamp.
        self._progress = ProgressFile(Path(f"{settings.summary}.stamp")) if settings.summary else None
        self._newest = self._progress.stamp if self._progress else 0
        player.create_subscription(Header, CAMERA_ALIVE, self._on_latched, ALIVE)
        self._owner = ClockOwner(player, settings.clock_search)
        self._clock_publisher: Any = None
        player.create_subscription(Header, FRAME_DONE, self._on_done, REPORTS)
        player.create_timer(_LOOK_EVERY, self.work, clock=steady)
        if settings.pace:
            player.create_timer(1 / settings.pace, self._on_pace, clock=steady)

    # --- interface of all players

    @property
    def is_paused(self) -> bool:
        """Whether frames are sent only on request. Simulated time stands still between them."""
        return self._is_paused

    @property
    def waiting(self) -> int:
        """Number of requested frames that are not sent yet."""
        return len(self._steps)

    def pause(self, paused: bool) -> None:
        """Pause after the frame in flight, or continue."""
        self._is_paused = paused
        self._advance()

    def step(self, done: Callable[[], object] | None = None) -> Tick:
        """Play a frame during a pause, and return it. ``done``: called when all members have finished it."""
        self._steps.append(done)
        tick = self._planned(len(self._steps))
        self._advance()
        return tick

    def seek(self, seconds: float) -> Tick:
        """Show a scene time in the next frame. It is sent even during a pause."""
        self.clock.seek(seconds)
        tick = self._planned(1)
        if self._is_paused and not self._steps:
            self._steps.append(None)
        self._advance()
        return tick

    def follow_rate(self) -> None:
        """Do nothing, since the next frame has the new period anyway."""

    def report(self, stamp: int) -> None:
        """Count odometry with this stamp as a report, if frames wait for the topic of the odometry."""
        for name in self._odometry:
            self._on_report(name, stamp)

    def work(self) -> None:
        """Check the members. If some are missing, send the frame again, print a reminder, or stop waiting."""
        now = time.monotonic()
        self._now += min(now - self._last_look, _MAX_STEP)
        self._last_look = now
        if self._is_over:
            return
        if self._clock_publisher is None:
            self._begin()
        elif not self.state.is_finished:
            self._look_at_members()
        elif self._is_paused and self._now >= self._next_graph:
            self._next_graph = self._now + _GRAPH_EVERY
            if self._graph.has_grown():
                self.state.add_node(self._now)
            self._repeat_if_due()

    # --- start

    def _begin(self) -> None:
        """Publish the first frame as soon as it is certain that no other node publishes ``/clock``."""
        owner = self._owner.check()
        if owner is None:
            return
        if owner:
            self._stop(WRONG_INPUT, owner)
            return
        self._owner.close()
        self._clock_publisher = self.player.create_publisher(Clock, "/clock", _CLOCK_QUEUE)
        self.player.get_logger().info("lockstep: waiting for " + _names(self.state.members))
        if self._newest:
            self._go_on()
        self._seconds = (time.monotonic(), time.monotonic())
        self._advance()

    def _on_latched(self, report: Header) -> None:
        """Read the newest report of a camera that ran before this player."""
        # not destroyed when it has served: more reports may wait, and the executor would fail at them
        if any(self.state.finished.values()):
            return
        names = {self._name(each) for each in report.frame_id.split(", ")}
        stamp = to_nanoseconds(report.stamp)
        if not self._newest < stamp <= _MAX_STAMP or names.isdisjoint(self.player.scene.cameras):
            return
        self._newest = stamp
        if self.state.stamp is not None and self.state.stamp < stamp:  # found late
            self.state.withdraw()
            self._go_on()
            self._advance()

    def _go_on(self) -> None:
        """Continue with the newest frame that a camera has finished."""
        self._before = self.clock.begin_at(self._newest)
        self.player.get_logger().info(f"going on with frame {self._before}")

    def _name(self, text: str) -> str:
        """Name of a node relative to the namespace of the player."""
        namespace = self.player.get_namespace().strip("/")
        name = text.strip().strip("/")
        return name.removeprefix(f"{namespace}/") if namespace else name

    # --- reports

    def _on_done(self, report: Header) -> None:
        stamp = to_nanoseconds(report.stamp)
        for text in report.frame_id.split(", "):
            if name := self._name(text):
                self._on_report(name, stamp)

    def _on_report(self, name: str, stamp: int) -> None:
        is_new = name not in self.state.members
        if self.state.add_report(name, stamp, self._now) and is_new:
            self.player.get_logger().info(
                f"frames wait for {printable(name, 80)}, too, which has reported one"
            )
        if self.state.is_finished:
            self._seconds = (self._seconds[0], time.monotonic())
        self._advance()

    # --- frames

    def _on_pace(self) -> None:
        self._is_due = True
        self._advance()

    def _advance(self) -> None:
        """Send the next frame if its time has come."""
        if self._clock_publisher is None or self._is_over or not self.state.is_finished:
            return
        if self._done is not None:
            done, self._done = self._done, None
            done()
        if self._settings.frames and self._before + self.state.sent >= self._settings.frames:
            self._end()
            return
        if not self.state.is_finished or (self._is_paused and not self._steps):
            return
        if self._settings.pace and not self._is_due:
            return
        self._is_due = False
        self._done = self._steps.popleft() if self._steps else None
        self._send_next()

    def _send_next(self) -> None:
        tick = self.clock.next()
        shown = self._take_prepared(tick)
        self._frame = tick, shown
        self.state.begin(tick.stamp, self._now, self._resting(tick.index))
        if self._progress is not None:
            self._progress.write(tick.stamp)
        self._send()
        self._prepare()

    def _resting(self, index: int) -> Collection[str]:
        """Members that do not report this frame. If no camera captures the frame, these are all members
        outside the scene, since they answer images."""
        scene = self.player.scene
        cameras = scene.scene_cameras.values()
        if not cameras or any(index in camera.timing for camera in cameras):
            return ()
        return self.state.members.keys() - {*_finishing(scene), self._settings.recorder, TEST_NODE}

    def _take_prepared(self, tick: Tick) -> SceneState:
        """Poses of a frame: those computed in advance or, if something has changed since, new ones."""
        playback = self.player.playback
        if self._prepared is not None:
            prepared, version, shown = self._prepared
            if prepared == tick and version == playback.version:
                playback.elapsed = tick.elapsed
                return shown
        return playback.show(tick.elapsed, tick.pace)

    def _prepare(self) -> None:
        """Compute the next frame while the members work on this one."""
        playback = self.player.playback
        tick, shown = self._planned(1), playback.elapsed
        self._prepared = tick, playback.version, playback.show(tick.elapsed, tick.pace)
        playback.elapsed = shown

    def _planned(self, frames: int) -> Tick:
        """The frame that will be shown ``frames`` frames later, if nothing is changed until then."""
        clock = copy.copy(self.clock)
        for _ in range(frames - 1):
            clock.next()
        return clock.next()

    def _send(self) -> None:
        """Send the frame in flight."""
        assert self._frame is not None
        self._clock_publisher.publish(Clock(clock=to_time(self._frame[0].stamp)))
        self.player.send_frame(*self._frame)

    # --- members that are late

    def _look_at_members(self) -> None:
        now, state = self._now, self.state
        if state.waited(now) > _GRAPH_AFTER and now >= self._next_graph:
            self._next_graph = now + _GRAPH_EVERY
            if self._graph.has_grown():
                state.add_node(now)
            try:
                self._topics.update()
            except RosError as error:
                text = f"wait_for {error}. Let its node report on frame_done in its place (docs/lockstep.md)"
                self._stop(WRONG_INPUT, text)
                return
            self._remove_members()
        if (overdue := state.overdue(now)) and (overdue := self._overdue_since_restart(overdue)):
            self._give_up(overdue)
        self._repeat_if_due()
        if state.is_reminder_due(now):
            missing = _names(each.name for each in state.missing)
            self.player.get_logger().warn(
                f"frame {self._number} waits for {missing} since {state.waited(now):.0f} s"
            )
        self._advance()

    def _repeat_if_due(self) -> None:
        if self.state.is_due_again(self._now, self._is_paused):
            self.state.add_repeat(self._now)
            self._send()

    @property
    def _number(self) -> int:
        """Number of the frame in flight, counted from the start of the run."""
        return self._before + self.state.sent - 1

    def _remove_members(self) -> None:
        """Remove members that had joined by a report, if their publisher has left the graph."""
        publishers = publishers_of(self.player, self.player.resolve_topic_name(FRAME_DONE))
        joined = [name for name, each in self.state.members.items() if not each.required]
        nodes = {self._name(each.node) for each in publishers.values()}
        for name in joined:
            own = {gid for gid, each in publishers.items() if self._name(each.node) == name}
            # without a node of that name: any node that is not another member may be the reporter
            own = own or {
                gid for gid, each in publishers.items() if self._name(each.node) not in self.state.members
            }
            before = self._reporters.setdefault(name, own)
            if name in nodes:
                self._reporters[name] = own
            elif not before & publishers.keys():
                del self._reporters[name]
                self.state.leave(name)
                self.player.get_logger().info(f"{printable(name, 80)} has left: frames wait for it no longer")

    def _overdue_since_restart(self, overdue: list[Member]) -> list[Member]:
        """Members that are still overdue when the last restart of a node has been taken into account."""
        age = RestartFile(self._settings.summary).age() if self._settings.summary else None
        if age is None or self._now - age < 0:
            return overdue
        self.state.restart(self._now - age)
        return self.state.overdue(self._now)

    def _give_up(self, overdue: list[Member]) -> None:
        names = _names(each.name for each in overdue)
        text = f"frame {self._number}: {names} did not finish it within {self._settings.timeout:g} s"
        if self._settings.on_timeout == "stop":
            self._stop(TIMED_OUT, text)
        elif self.state.give_up(overdue):
            self.player.get_logger().warn(f"{text}; going on without until it reports again")

    # --- end

    def _end(self) -> None:
        """End the process after the last frame."""
        self.close()
        self.player.exit_code = 0

    def _stop(self, code: int, text: str) -> None:
        """End the process with an error."""
        self.player.get_logger().error(text)
        self.close(text)
        self.player.exit_code = code

    def close(self, error: str = "") -> None:
        """Send no more frames, and write the summary. ``error``: why the run ends early, or empty."""
        if self._is_over:
            return
        self._is_over = True
        if self._progress is not None:
            self._progress.remove()
        begin, end = self._seconds
        sent, frames = self.state.sent, self._before + self.state.sent
        summary = LockstepSummary(
            frames=frames,
            sent=sent,
            finished=self.state.finished,
            seconds=round(end - begin, 3) if begin else 0.0,
            scene_seconds=sent * self.clock.period * 1e-9,
            is_complete=bool(self._settings.frames) and not error and frames >= self._settings.frames,
            error=error,
        )
        if self._settings.summary:
            summary.write(self._settings.summary)
        else:
            self.player.get_logger().info(summary.text)


def _names(names: Any) -> str:
    """Names of members for a log line."""
    return printable(", ".join(names), _MAX_TEXT)
