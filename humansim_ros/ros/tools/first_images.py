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

    def report(self, seconds: float) -> str:
        """Lines that are printed when all cameras have delivered."""
        count = len(self.cameras)
        cameras = f"all {count} cameras deliver" if count > 1 else f"{self.cameras[0]} delivers"
        truth = [self._topic(f"humans/{human}/joints") for human in self.humans]
        view = f"humansim view --ros{f' --namespace {self.namespace}' if self.namespace else ''}"
        command = f"ros2 topic hz {self.topics[0]}" if shutil.which("ros2") else view
        return (
            f"{cameras}, after {seconds:.1f} s\n"
            f"ROS domain {os.environ.get('ROS_DOMAIN_ID', '0')}: images on {some_of(self.topics, _MAX_NAMES)}"
            f"{f'; truth on {some_of(truth, _MAX_NAMES)}' if truth else ''}\n"
            f"next, in another terminal: {command}"
        )

    @property
    def topics(self) -> list[str]:
        """Topics of the images."""
        return [self._topic(f"{camera}/image_raw") for camera in self.cameras]

    def _topic(self, name: str) -> str:
        return f"/{self.namespace}/{name}" if self.namespace else f"/{name}"

    def wait(self) -> None:
        """Subscribe to all cameras until each has delivered an image, and print progress and report."""
        from sensor_msgs.msg import Image

        from humansim_ros.ros.processes.runtime import prepare_transport
        from humansim_ros.ros.tools.listener import Listener

        prepare_transport()
        cameras = dict(zip(self.topics, self.cameras, strict=True))
        with Listener("humansim_run") as listener:
            for topic in cameras:
                listener.listen(Image, topic)
            next_line = _FIRST_PROGRESS
            while listener.silent:
                listener.spin(0.05)
                for topic in listener.subscriptions.keys() - set(listener.silent):
                    # nothing more is rendered for this subscription
                    listener.node.destroy_subscription(listener.subscriptions.pop(topic))
                seconds = time.monotonic() - self.start
                if listener.silent and seconds > next_line:
                    next_line = 2 * seconds
                    waiting = [cameras[topic] for topic in listener.silent]
                    print(self.progress(waiting, seconds), flush=True)
            print(self.report(time.monotonic() - self.start), flush=True)
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(_LEAVE_LIMIT)


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
