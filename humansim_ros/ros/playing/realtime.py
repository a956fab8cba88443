"""Playing in real time: a frame is sent before its stamp on the wall clock, or skipped."""

from __future__ import annotations

import os
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence

from rclpy.event_handler import QoSLivelinessChangedInfo, SubscriptionEventCallbacks
from std_msgs.msg import Header

from humansim_ros.data.messages import to_nanoseconds
from humansim_ros.ros.graph.clock import ClockSteps
from humansim_ros.ros.graph.qos import ALIVE, CAMERA_ALIVE, FRAME_DONE, REPORTS
from humansim_ros.ros.playing.clock import Tick
from humansim_ros.ros.playing.playing import MAX_WAITING, FramePlayer, Playing
from humansim_ros.scene.core import SceneState

#: Most sent frames that are remembered.
_MAX_SENT = 128
#: For this many periods after its stamp, a frame that a camera still works on does not stop the next two
#: frames, so that a short delay loses no frame.
_PERIODS_OF_GRACE = 2.5
#: Most camera processes that frames wait for.
_MAX_CAMERAS = 100
#: A camera without a report for the first number of seconds no longer delays the others. For a slow camera,
#: the time is the second number times the time of its last frame, at most the third number of seconds.
_GIVE_UP_AFTER, _FRAMES_WAITED, _LONGEST_WAIT = 2.0, 4.0, 10.0
#: Text for drops while camera processes run, but none has reported yet.
_UNHEARD = "cameras, none of which has reported yet"
#: Seconds without a report after which a camera is forgotten during a pause.
_FORGET_AFTER = 10.0
#: During a pause, the pose is sent again after this time, seconds. Otherwise a slow subscriber might never
#: get the last image.
_REPEAT_AFTER = 0.5
#: Drops of the last seconds, this many, are considered for the reason in the log.
_REASON_OVER = 1.0


def pace_reason(causes: Mapping[str, int], load: float, cores: int) -> str:
    """Text for the user on why frames are dropped, and what helps.

    Args:
        causes: Number of dropped frames by name of the late camera. The empty name stands for the player.
        load: Load of this machine: mean number of processes that want to run.
        cores: Number of processors.
    """
    cameras = sorted(name for name in causes if name)
    named = ", ".join(cameras[:3]) + (f" and {len(cameras) - 3} more" if len(cameras) > 3 else "")
    reasons = [f"the motion player waits for {named}"] * bool(cameras) + ["the motion player is late"] * (
        "" in causes
    )
    if load > cores:
        reasons.append(f"{load:.0f} processes share {cores} processor{'s' * (cores > 1)}")
    return ", ".join(reasons) + "; lower rate or image sizes, or play in lockstep, which drops nothing"


class FramePacing:
    """Knows which frames the cameras have not finished yet, from the reports of the cameras.

    A camera that is late would have to skip frames. Each camera would skip different frames, so that hardly
    any frame would be complete. So the sender skips frames for all cameras, and a camera renders every frame
    that it gets.

    If camera processes run but none reports (all of them draw their static scenes), frames are sent less
    often. Otherwise skinners and queues of cameras would be full of frames that hardly any camera completes.

    Stamps are nanoseconds; ``now`` is in monotonic seconds.
    """

    def __init__(self) -> None:
        self._sent: deque[tuple[int, float]] = deque(maxlen=_MAX_SENT)
        # by camera: the newest stamp that it has finished, and the time of this report
        self._finished: dict[str, tuple[int, float]] = {}
        # by camera, including those that were given up: newest stamp, and seconds from sending to the report
        self._took: dict[str, tuple[int, float]] = {}
        #: number of running camera processes; and time of its last change or of the last report that counted
        self._processes, self._heard = 0, 0.0

    def add_sent(self, stamp: int, now: float) -> None:
        """Record a frame that is sent."""
        if self._sent and stamp <= self._sent[-1][0]:  # the clock has been set back
            self._sent.clear()
            self.forget_cameras()
        self._sent.append((stamp, now))

    def add_finished(self, camera: str, stamp: int, now: float) -> None:
        """Record that a camera has finished a frame and all earlier frames. Reports of unknown frames are
        ignored, since they come from cameras of another player. So are reports of frames older than ten
        seconds while other cameras report, so that a very slow camera does not delay others."""
        took = next((now - at for sent, at in self._sent if sent == stamp), None)
        if took is None or (took > _LONGEST_WAIT and self._finished):
            return
        if took > _GIVE_UP_AFTER and stamp <= self._took.get(camera, (0, 0.0))[0]:
            return  # a repeated report
        self._heard = now
        finished, _ = self._finished.get(camera, (None, 0.0))
        if finished != stamp and (finished is not None or len(self._finished) < _MAX_CAMERAS):
            self._finished[camera] = (stamp, now)
            self._took[camera] = stamp, took

    def set_processes(self, number: int, now: float) -> None:
        """Record how many camera processes run. If one has ended, forget all cameras until they report
        again."""
        if number < self._processes:
            self.forget_cameras()
        self._processes, self._heard = number, now

    def forget_cameras(self) -> None:
        """Forget all reports."""
        self._finished.clear()
        self._took.clear()

    def late_cameras(self, stamp: int, period: float, now: float) -> list[str]:
        """Names of the cameras that have no time for a frame with this stamp.

        A camera may have one unfinished frame, or two recent ones, so that it never waits for frames.

        Args:
            stamp: Stamp of the frame, nanoseconds.
            period: Time between frames, nanoseconds.
            now: Monotonic seconds.
        """
        if self._is_unheard(now):
            return [_UNHEARD]
        late = []
        for camera, (finished, heard) in list(self._finished.items()):
            pending = [sent for sent in self._sent if sent[0] > finished]
            if len(pending) < 2:
                continue
            oldest, sent_at = pending[0]
            if len(pending) == 2 and stamp - oldest <= _PERIODS_OF_GRACE * period:
                continue
            wait = min(max(_GIVE_UP_AFTER, _FRAMES_WAITED * self._took[camera][1]), _LONGEST_WAIT)
            if now - max(heard, sent_at) > wait:
                # it has ended, or waits for something: it counts again when it reports
                del self._finished[camera]
            else:
                late.append(camera)
        return late

    def _is_unheard(self, now: float) -> bool:
        """Whether no camera reports, and the last frame was sent too recently to send another one. The time
        between frames grows with the silence, from one period to two seconds."""
        if self._finished or not self._processes or not self._sent:
            return False
        last = self._sent[-1][1]
        return now - last < min(last - self._heard, _GIVE_UP_AFTER)

    def may_send_paused(self, unfinished: int, now: float) -> bool:
        """Whether a frame may be sent during a pause.

        No frame of a pause may be lost, since it may be a step. So a frame is sent only while each camera has
        at most ``unfinished`` frames to finish, which must fit into the queue of the camera. A camera that
        does not report delays each frame by two seconds, until it is forgotten.
        """
        if not self._sent or now - self._sent[-1][1] > _GIVE_UP_AFTER:
            return True
        for camera, (finished, heard) in list(self._finished.items()):
            pending = [sent_at for stamp, sent_at in self._sent if stamp > finished]
            if pending and now - max(heard, pending[0]) > _FORGET_AFTER:
                del self._finished[camera]
            elif len(pending) > unfinished:
                return False
        return True

    def may_repeat(self, now: float) -> bool:
        """Whether the frame of a pause may be sent again: all cameras finished it at least half a second
        ago."""
        return self.may_send_paused(0, now) and (not self._sent or now - self._sent[-1][1] >= _REPEAT_AFTER)


class RealtimePlaying(Playing):
    """Sends frame k at start + round(k * period) on the node's clock.

    A late player skips to the newest frame and counts the drops. Cameras report each finished frame on
    ``frame_done``. A frame that a camera has no time for is skipped, so that all cameras show the same
    frames.

    Args:
        player: The node.
        lead: Nanoseconds by which frames are sent before their stamps, at most a period.
    """

    def __init__(self, player: FramePlayer, lead: float) -> None:
        super().__init__(player)
        self._requested_lead = lead
        self._clock_steps = ClockSteps(lambda: player.now(), player.has_simulated_time)
        self._pacing = FramePacing()
        #: Frames requested during a pause (steps, seeks) that wait until cameras have time for them.
        self._waiting: deque[tuple[Tick, SceneState, Callable[[], object] | None]] = deque()
        #: Monotonic seconds and causes of the last drops, as :func:`pace_reason` takes them.
        self._drops: deque[tuple[float, str, int]] = deque(maxlen=_MAX_SENT)
        player.create_subscription(Header, FRAME_DONE, self._on_frame_done, REPORTS)
        events = SubscriptionEventCallbacks(liveliness=self._on_liveliness)
        player.create_subscription(Header, CAMERA_ALIVE, lambda _: None, ALIVE, event_callbacks=events)
        self.timer = player.create_timer(self.clock.period * 1e-9, self.work)

    @property
    def is_paused(self) -> bool:
        """Whether scene time stands still. During a pause, the same pose is sent twice a second."""
        return self.clock.paused

    @property
    def waiting(self) -> int:
        """Number of requested frames that wait for the cameras."""
        return len(self._waiting)

    def pause(self, paused: bool) -> None:
        """Pause, or continue."""
        self.clock.pause(paused)

    def step(self, done: Callable[[], object] | None = None) -> Tick:
        """Send a frame during a pause, as soon as the cameras have time for it. Returns the frame.

        ``done``: called when it is sent.
        """
        tick = self.clock.step(self._stamp_now())
        self._send_at_once(tick, done)
        return tick

    def seek(self, seconds: float) -> Tick:
        """Send a frame of a scene time now, and continue from it."""
        self.clock.seek(seconds)
        tick = self.clock.cut(self._stamp_now())
        self._send_at_once(tick)
        return tick

    def follow_rate(self) -> None:
        """Send a frame now. The stamps of later frames are counted from this frame."""
        self._send_at_once(self.clock.cut(self._stamp_now()))

    def work(self) -> None:
        """Send the frame that is due."""
        self._send_waiting()
        now = self._stamp_now()
        tick = self.clock.due(now)
        if tick is None:
            return
        if tick.stamp == now:
            # frames are counted from here: the timer was late, so it would be early for all later frames,
            # and each would wait for the next call of the timer
            self.timer.reset()
        if self.clock.paused or self._waiting:
            # the same pose again; a step is not lost among such frames
            if not self._waiting and self._pacing.may_repeat(time.monotonic()):
                self.send_tick(tick)
            return
        late = self._pacing.late_cameras(tick.stamp, self.clock.period, time.monotonic())
        if late:
            self._count_drops(1 + tick.dropped, late)
            return
        self.send_tick(tick)

    def send_tick(self, tick: Tick) -> None:
        """Compute and send a frame."""
        self._send(tick, self.player.playback.show(tick.elapsed, tick.pace))

    @property
    def _lead(self) -> int:
        """Nanoseconds by which frames are sent ahead, at most a period, so that none queue up at skinners."""
        return round(min(self._requested_lead, self.clock.period))

    def _stamp_now(self) -> int:
        """Stamp of a frame that is sent now."""
        now, step = self._clock_steps.read()
        if step:
            self._follow_clock(step)
        return now + self._lead

    def _follow_clock(self, step: int) -> None:
        """Go on after the clock was set by ``step`` nanoseconds."""
        started = self.clock.last is not None
        self.clock.shift(step)
        if not started:
            return
        clock = "simulated time" if self.player.has_simulated_time() else "the system clock"
        step_text = f"{abs(step) * 1e-9:.2f} s {'ahead' if step > 0 else 'back'}"
        text = f"{clock} was set {step_text}: stamps jump with it, scene time goes on"
        self.player.get_logger().warn(text, throttle_duration_sec=5.0)
        if step < 0:  # no legend may be of a later stamp than its motion
            self.player.restart_legends()

    def _on_frame_done(self, report: Header) -> None:
        self._pacing.add_finished(report.frame_id, to_nanoseconds(report.stamp), time.monotonic())
        self._send_waiting()

    def _on_liveliness(self, change: QoSLivelinessChangedInfo) -> None:
        self._pacing.set_processes(change.alive_count, time.monotonic())

    def _send_waiting(self) -> None:
        """Publish the next waiting frames that the cameras have time for."""
        while self._waiting and self._pacing.may_send_paused(1, time.monotonic()):
            tick, shown, done = self._waiting.popleft()
            self._send(tick, shown)
            if done is not None:
                done()

    def _send(self, tick: Tick, shown: SceneState) -> None:
        self._pacing.add_sent(tick.stamp, time.monotonic())
        self.player.send_frame(tick, shown)
        if tick.dropped:
            self._count_drops(tick.dropped, [""])
        self.player.report_lateness(tick.stamp - self._lead)

    def _count_drops(self, number: int, causes: Sequence[str]) -> None:
        """Count dropped frames. ``causes``: late cameras, or the empty name for the player itself."""
        now = time.monotonic()
        self.player.count("drops", number)
        self._drops.extend((now, cause, number) for cause in causes)
        recent: Counter[str] = Counter()
        for at, cause, count in self._drops:
            if now - at <= _REASON_OVER:
                recent[cause] += count
        self.player.drop_reason = pace_reason(recent, os.getloadavg()[0], os.cpu_count() or 1)

    def _send_at_once(self, tick: Tick, done: Callable[[], object] | None = None) -> None:
        """Publish a frame between two calls of the timer. Timer and clock continue from here. During a pause
        the frame waits until all cameras have time for it, so that no camera loses it."""
        self.timer.timer_period_ns = round(self.clock.period)
        self.timer.reset()
        shown = self.player.playback.show(tick.elapsed, tick.pace)
        if not (self.clock.paused or self._waiting):
            self._send(tick, shown)
            if done is not None:
                done()
        elif len(self._waiting) < MAX_WAITING:  # else shown by the next frames of the pause
            self._waiting.append((tick, shown, done))
            self._send_waiting()
