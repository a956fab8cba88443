"""Lockstep of a whole scene with a slow tracker: frames that are sent, received and tracked, and their rate.

    python benchmarks/lockstep.py [SCENE] [--frames 1000] [--sleep 0.05]

The tracker sleeps up to ``--sleep`` seconds for each frame (``tools/slow_tracker.py``). A frame is received
if this process got the images of all cameras, and tracked if the tracker got them. Exit code 1: a frame is
lost.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

import rclpy
from sensor_msgs.msg import Image
from slow_tracker import tracked_stamps

from humansim_ros.data.messages import serialised_stamp
from humansim_ros.data.messages.frames import Frames
from humansim_ros.files.reading.assets import resource_path
from humansim_ros.ros.processes.runtime import make_executor, prepare_transport
from humansim_ros.scene.core.scene import DEMO_SCENE, Scene

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    """Run, and print the numbers."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", type=Path, default=resource_path(DEMO_SCENE))
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument(
        "--sleep", type=float, default=0.05, help="longest time of the tracker for a frame, seconds"
    )
    options = parser.parse_args()
    scene = Scene.load(options.scene)
    cameras = list(scene.cameras)
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "tracked")
        tracker = [sys.executable, str(ROOT / "tools" / "slow_tracker.py"), str(log), *cameras]
        run = [sys.executable, "-m", "humansim_ros.cli", "run", str(options.scene), "--lockstep"]
        run += [
            "--frames",
            str(options.frames),
            "--wait-for",
            "topic:/tracker/poses",
            "--wait-for",
            "receiver",
        ]
        prepare_transport()
        received = Receiver(cameras)
        with (
            subprocess.Popen([*tracker, "--sleep", str(options.sleep)]) as tracking,
            subprocess.Popen(run, env={**os.environ, "PYTHONPATH": str(ROOT)}) as running,
        ):
            code = received.spin_until_end(running)
            tracking.terminate()
        tracked = tracked_stamps(log)
    expected = [1 + scene.frame_time(number) for number in range(options.frames)]
    whole = sorted(received.whole)
    print(f"sent {options.frames}, received {len(whole)}, tracked {len(tracked)} frames")
    return 0 if code == 0 and whole == tracked == expected else 1


class Receiver:
    """Receives the images of all cameras in this process, and reports each whole frame."""

    def __init__(self, cameras: list[str]) -> None:
        from std_msgs.msg import Header

        rclpy.init(args=[])
        self._node = rclpy.create_node("receiver")
        self._executor = make_executor()
        self._executor.add_node(self._node)
        self._frames: Frames[None] = Frames(cameras)
        self.whole: set[int] = set()
        self._done = self._node.create_publisher(Header, "/frame_done", 10)
        for camera in cameras:
            self._node.create_subscription(
                Image, f"/{camera}/image_raw", lambda data, name=camera: self._add(name, data), 10, raw=True
            )

    def _add(self, camera: str, data: bytes) -> None:
        from humansim_ros.data.messages import header

        stamp = serialised_stamp(data)
        if self._frames.add(camera, stamp, None):
            self._frames.pop(stamp)
            self.whole.add(stamp)
            self._done.publish(header(stamp, "receiver"))

    def spin_until_end(self, running: subprocess.Popen[bytes]) -> int:
        """Receive until a process ends; returns its exit code."""
        while running.poll() is None:
            self._executor.spin_once(0.1)
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown()
        return running.returncode


if __name__ == "__main__":
    sys.exit(main())
