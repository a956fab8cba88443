"""Pacing of frames: the motion player sends a frame only if all cameras have time for it."""

from __future__ import annotations

from collections import deque

#: Newest sent frames that are remembered.
_MAX_SENT = 128
#: Periods after the stamp of a frame until which two more may be sent while a camera still works on it: so
#: that a short delay loses no frame.
_PERIODS_OF_GRACE = 2.5
#: Camera processes that are waited for.
_MAX_CAMERAS = 100
#: Seconds without a report after which a camera no longer delays the others.
_GIVE_UP_AFTER = 2.0
#: Seconds without a report after which a camera is forgotten during a pause.
_FORGET_AFTER = 10.0
#: Seconds after which a paused pose is sent again: later images push earlier ones out of the queue to a slow
#: subscriber.
_REPEAT_AFTER = 0.5


class FramePacing:
    """Frames that cameras have not finished yet, by the reports of the cameras.

    A camera that is late would have to skip frames. Each camera would skip others, and hardly a frame would
    be complete. Therefore the sender skips them for all cameras, and a camera renders every frame that it
    gets.

    Stamps are nanoseconds; ``now`` is in monotonic seconds.
    """

    def __init__(self) -> None:
        self._sent: deque[tuple[int, float]] = deque(maxlen=_MAX_SENT)
        # by camera: the newest stamp that it has finished, and the time of this report
        self._finished: dict[str, tuple[int, float]] = {}

    def add_sent(self, stamp: int, now: float) -> None:
        """Record a frame that is sent."""
        if self._sent and stamp <= self._sent[-1][0]:  # the clock has been set back
            self._sent.clear()
            self._finished.clear()
        self._sent.append((stamp, now))

    def add_finished(self, camera: str, stamp: int, now: float) -> None:
        """Record the report of a camera that it has finished a frame, and with it all earlier ones.

        Only frames of the last two seconds count: reports of other frames are of the cameras of another
        player, or of a camera that no longer delays the others.
        """
        if not any(sent == stamp and now - at <= _GIVE_UP_AFTER for sent, at in self._sent):
            return
        finished, _ = self._finished.get(camera, (None, 0.0))
        if finished != stamp and (finished is not None or len(self._finished) < _MAX_CAMERAS):
            self._finished[camera] = (stamp, now)

    def forget_cameras(self) -> None:
        """Forget all reports, because a camera is gone: each camera counts again when it reports."""
        self._finished.clear()

    def late_cameras(self, stamp: int, period: float, now: float) -> list[str]:
        """Names of the cameras that have no time for a frame of this stamp.

        One unfinished frame is allowed, so that a camera has the next one when it finishes; two are if they
        are recent.

        Args:
            stamp: Stamp of the frame, nanoseconds.
            period: Time between frames, nanoseconds.
            now: Monotonic seconds.
        """
        late = []
        for camera, (finished, heard) in list(self._finished.items()):
            pending = [sent for sent in self._sent if sent[0] > finished]
            if len(pending) < 2:
                continue
            oldest, sent_at = pending[0]
            if len(pending) == 2 and stamp - oldest <= _PERIODS_OF_GRACE * period:
                continue
            if now - max(heard, sent_at) > _GIVE_UP_AFTER:
                # it has ended, or waits for something: it counts again when it reports
                del self._finished[camera]
            else:
                late.append(camera)
        return late

    def may_send_paused(self, unfinished: int, now: float) -> bool:
        """Whether a frame may be sent during a pause.

        No frame of a pause may be lost, as it may be a step. So it is sent only while no camera has more than
        ``unfinished`` frames to finish: they must fit into its queue. A camera that does not report delays
        each frame by two seconds, until it is forgotten.
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
        """Whether the pose of a pause may be sent again: all cameras have finished it, half a second ago."""
        return self.may_send_paused(0, now) and (not self._sent or now - self._sent[-1][1] >= _REPEAT_AFTER)
