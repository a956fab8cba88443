"""Node ``motion_player``: plays the motions of a scene's humans, all from one clock.

Publishes ``humans/<id>/motion``, and ``objects/<name>/marker`` of every object that moves. Frame k leaves at
start + round(k * period) on the wall clock and carries that stamp; a player that is late skips to the newest
frame and reports the drop.
"""

from __future__ import annotations

import sys
from typing import Any

from sensor_msgs.msg import MultiDOFJointState
from visualization_msgs.msg import Marker

from humansim_ros.ros.messages import motion_message, object_message
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import DATA
from humansim_ros.ros.runtime import run_node


class MotionPlayer(SceneNode):
    """Publishes where the joints of every motion are, frame by frame."""

    def __init__(self, **options: Any) -> None:
        super().__init__("motion_player", **options)
        rate = self.number_parameter(
            "rate", 0.0, 0.0, 1000.0, "Frames per second; 0 for the scene's own rate"
        )
        self._period = 1e9 / (rate or self.scene.config.rate)
        self._motions = {
            name: self.create_publisher(MultiDOFJointState, f"humans/{name}/motion", DATA)
            for name in self.scene.actors
        }
        self._markers = {
            name: self.create_publisher(Marker, f"objects/{name}/marker", DATA)
            for name in self.scene.moving_objects
        }
        self._start: int | None = None
        self._next = 0
        self.create_timer(self._period * 1e-9, self._tick)
        frames = 1e9 / self._period
        self.get_logger().info(
            f"playing {len(self._motions)} motions at {frames:g} Hz from {self.scene.path}"
        )

    def _tick(self) -> None:
        now = self.now()
        if self._start is None:
            self._start = now
        # the timer may come a moment early: a frame is due from a tenth of a period before its time
        due = int((now - self._start) / self._period + 0.1)
        if due < self._next:
            return
        self.count("drops", due - self._next)
        self._next = due + 1
        elapsed = round(due * self._period)
        stamp = self._start + elapsed
        for name, actor in self.scene.actors.items():
            self._motions[name].publish(motion_message(actor.joint_poses(elapsed * 1e-9), stamp))
        for name, thing in self.scene.moving_objects.items():
            self._markers[name].publish(object_message(thing, thing.at(elapsed * 1e-9), stamp))
        self.count("frames")
        self.report_lateness(stamp)


def main() -> int:
    return run_node(MotionPlayer)


if __name__ == "__main__":
    sys.exit(main())
