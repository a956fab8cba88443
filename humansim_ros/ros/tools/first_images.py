"""Wait until all cameras of ``humansim run`` deliver images, then print how long this took, and commands to
try next.

It runs as a separate process: ``python -m humansim_ros.ros.tools.first_images JSON``.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from humansim_ros.errors import some_of
from humansim_ros.ros.processes.stop_signals import end_process_on_stop, end_with_parent

#: Seconds until the first line about cameras that have not delivered yet. The time to each further line
#: doubles.
_FIRST_PROGRESS = 3.0
#: Most names of a list that are printed.
_MAX_NAMES = 4
#: The shutdown of ROS is aborted after this time, seconds, since Fast DDS sometimes hangs.
_LEAVE_LIMIT = 5


@dataclass(frozen=True)
class FirstImages:
    """Waits for the first image of each camera, and reports on it.

    Attributes:
        cameras: Names of the cameras.
        humans: Names of the humans.
        start: Monotonic time of the start, seconds.
        namespace: ROS namespace of the nodes, without the first /.
    """

    cameras: Sequence[str]
    humans: Sequence[str]
    start: float
    namespace: str = ""

    def to_argument(self) -> str:
        """These attributes as the command-line argument of the process."""
        return json.dumps(asdict(self))

    def progress(self, waiting: Sequence[str], seconds: float) -> str:
        """Line that is printed while some cameras have not delivered."""
        done = len(self.cameras) - len(waiting)
        return (
            f"{done} of {len(self.cameras)} cameras deliver after {seconds:.0f} s; waiting for "
            f"{some_of(waiting, _MAX_NAMES)} (the nodes load the scene; each camera draws its lens and room "
            "once)"
        )

    def report(self, seconds: float, checkout: Path | None = None) -> str:
        """Lines that are printed when all cameras have delivered. ``checkout``: folder of the repository with
        the examples. None if only the package is installed."""
        count = len(self.cameras)
        cameras = f"all {count} cameras deliver" if count > 1 else f"{self.cameras[0]} delivers"
        topics = [self._topic(f"{camera}/image_raw") for camera in self.cameras]
        truth = [self._topic(f"humans/{human}/joints") for human in self.humans]
        lines = [
            f"{cameras}, after {seconds:.1f} s",
            f"ROS domain {os.environ.get('ROS_DOMAIN_ID', '0')}: images on {some_of(topics, _MAX_NAMES)}"
            + (f"; truth on {some_of(truth, _MAX_NAMES)}" if truth else ""),
            "next, in another terminal:",
            *(f"    {command}" for command in self._commands(checkout)),
        ]
        return "\n".join(lines)

    def _topic(self, name: str) -> str:
        return f"/{self.namespace}/{name}" if self.namespace else f"/{name}"

    def _commands(self, checkout: Path | None) -> list[str]:
        topic = self._topic(f"{self.cameras[0]}/image_raw")
        if shutil.which("ros2"):
            view = (
                [f"ros2 run rqt_image_view rqt_image_view {topic}"] if shutil.which("rqt_image_view") else []
            )
            return [f"ros2 topic hz {topic}", *view]
        if checkout is not None and self.humans and len(self.cameras) > 1 and not self.namespace:
            return [f"python {checkout / 'examples' / 'tracker.py'} {self.humans[0]}"]
        section = "1. Give your tracker cameras"
        return [f'python my_tracker.py      # with the subscriber of README.md, section "{section}"']

    def wait(self) -> None:
        """Subscribe to all cameras until each has delivered an image, and print progress and report."""
        import rclpy
        from rclpy.qos import qos_profile_sensor_data
        from rclpy.signals import SignalHandlerOptions
        from sensor_msgs.msg import Image

        from humansim_ros.ros.graph.guarded_node import GuardedNode
        from humansim_ros.ros.processes.runtime import make_executor, prepare_transport

        prepare_transport()
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        node = GuardedNode("humansim_run")
        executor = make_executor()
        executor.add_node(node)
        delivered: set[str] = set()

        def listener(camera: str) -> Any:
            return lambda _: delivered.add(camera)

        subscriptions = {
            camera: node.create_subscription(
                Image, self._topic(f"{camera}/image_raw"), listener(camera), qos_profile_sensor_data, raw=True
            )
            for camera in self.cameras
        }
        next_line = _FIRST_PROGRESS
        while subscriptions:
            executor.spin_once(0.05)
            for camera in delivered & subscriptions.keys():
                # nothing more is rendered for this subscription
                node.destroy_subscription(subscriptions.pop(camera))
            seconds = time.monotonic() - self.start
            if subscriptions and seconds > next_line:
                next_line = 2 * seconds
                print(self.progress(list(subscriptions), seconds), flush=True)
        print(self.report(time.monotonic() - self.start, _checkout()), flush=True)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(_LEAVE_LIMIT)
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()


def _checkout() -> Path | None:
    """Folder of the repository. It is relative if it is below the current folder."""
    root = Path(__file__).resolve().parents[3]
    if not (root / "examples" / "tracker.py").is_file():
        return None
    return root.relative_to(Path.cwd()) if root.is_relative_to(Path.cwd()) else root


def main(argument: str) -> None:
    """Wait and report. Ends early on a stop signal, or if the output cannot be written."""
    end_process_on_stop(0)
    try:
        FirstImages(**json.loads(argument)).wait()
    except OSError:  # flushing the output at the end would fail again
        os._exit(0)


if __name__ == "__main__":
    end_with_parent()
    main(sys.argv[1])
