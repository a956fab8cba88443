"""The driver of a camera: sends images and their camera_info when, and as often as, its faults say."""

from __future__ import annotations

import heapq
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from rclpy.duration import Duration

from humansim_ros.messages.topics import Content, Topic
from humansim_ros.ros.node import SceneNode
from humansim_ros.scene.faults import FOLLOWING, NO_FAULTS, FrameFaults

#: Seconds in which subscribers take what is sent at the end of a run.
_MAX_WAIT = 1.0


class _Held(NamedTuple):
    """A message that is sent later. ``in_turn``: at the end of a frame, not when its time has come."""

    due: int
    number: int
    stamp: int
    in_turn: bool
    publisher: Any
    message: Any


class CameraDriver:
    """Sends the messages of a camera that its faults concern.

    Without faults a message is sent at once. Others are held until a frame has a stamp at which they are due:
    in lockstep, time stands between frames. In real time a timer sends them meanwhile.
    """

    def __init__(self, node: SceneNode) -> None:
        self._node = node
        self._held: list[_Held] = []
        self._number = 0
        self._timer: Any = None
        self._faults = NO_FAULTS

    @contextmanager
    def frame(self, stamp: int, faults: FrameFaults) -> Iterator[None]:
        """Context manager for the messages of one frame. ``stamp``: of the frame, nanoseconds."""
        self._faults = faults
        if self._held:  # a frame that is shown again, or the clock was set back: its messages come again
            self._held = [held for held in self._held if held.stamp < stamp]
            heapq.heapify(self._held)
            self._send_due(stamp)
        try:
            yield
        finally:
            self._send_due(stamp + FOLLOWING)
            self._set_timer()

    def send(self, topic: Topic[Content], publisher: Any, content: Content, stamp: int) -> None:
        """Send a message of the frame.

        Args:
            topic: Its topic.
            publisher: Publisher of the topic.
            content: Content of the message.
            stamp: Stamp of the frame, nanoseconds.
        """
        faults = self._faults if topic.faulty else NO_FAULTS
        if not faults.sent:
            return
        message = topic.build(content, faults.stamp(stamp))
        for after in faults.sent:
            if after == 0:
                publisher.publish(message)
                continue
            self._number += 1
            held = _Held(stamp + after, self._number, stamp, faults.follows, publisher, message)
            heapq.heappush(self._held, held)

    def send_held(self) -> None:
        """Send all messages that are held at the end of a run, and wait until they have been received."""
        if not self._held:
            return
        publishers = {id(held.publisher): held.publisher for held in self._held}
        self._send_due(max(held.due for held in self._held))
        deadline = time.monotonic() + _MAX_WAIT
        for publisher in publishers.values():
            left = max(0.0, deadline - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left))

    def _send_due(self, time: int) -> None:
        while self._held and self._held[0].due <= time:
            held = heapq.heappop(self._held)
            held.publisher.publish(held.message)

    def _set_timer(self) -> None:
        if not self._held or self._timer is not None or self._node.has_simulated_time():
            return
        seconds = max(1e-3, (self._held[0].due - self._node.now()) * 1e-9)
        self._timer = self._node.create_timer(seconds, self._on_timer)

    def _on_timer(self) -> None:
        self._node.destroy_timer(self._timer)
        self._timer = None
        now = self._node.now()
        while self._held and self._held[0].due <= now and not self._held[0].in_turn:
            held = heapq.heappop(self._held)
            held.publisher.publish(held.message)
        if self._held and not self._held[0].in_turn:
            self._set_timer()
