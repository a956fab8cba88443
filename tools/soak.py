"""Record a live scene of four cameras for a long time: memory of each process, rate and latency per minute.

    python tools/soak.py [--minutes 30] [--scene SCENE] [--rate 10] [--warm-up 5] [--keep 3] [--raw]

Runs the nodes of the scene and a recorder of compressed images (``--raw``: raw images), camera_info, joints
and vertices, with a new file of the bag each minute; only the newest ``--keep`` files are kept. Each minute
has a line: frames per second of the slowest camera, median time from a stamp to the publication of its
images, messages per second and drops of the recorder, and the memory of each process that is its own
(RssAnon, MB).

At the end, the growth of each process is the median of its last fifth of samples relative to the first fifth
after the warm-up; so are rate and latency. Exit code 1: a process has grown by 2 % or more, or has ended.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from humansim_ros.files.reading.assets import resource_path  # noqa: E402
from humansim_ros.ros.processes.node_processes import scene_processes  # noqa: E402
from humansim_ros.ros.processes.run_options import RecordOptions  # noqa: E402
from humansim_ros.ros.processes.runtime import prepare_transport  # noqa: E402
from humansim_ros.ros.processes.supervisor import Supervisor  # noqa: E402

COMPRESSED = ("/*/image_raw/compressed", "/*/depth/image/compressedDepth")
RAW = ("/*/image_raw", "/*/depth/image")
#: Recorded besides images.
TRUTH = ("/*/camera_info", "/*/joints", "/humans/*/vertices")
MAX_GROWTH = 0.02
#: Seconds between two samples of memory.
SAMPLE_EVERY = 5.0


class Diagnostics:
    """Frames, latency and drops that the nodes report each second."""

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.signals import SignalHandlerOptions

        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self._rclpy = rclpy
        self._node = rclpy.create_node("soak")
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_message, 100)
        #: Values of the last minute by node name and key.
        self.values: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))

    def _on_message(self, message: Any) -> None:
        for status in message.status:
            for pair in status.values:
                self.values[status.name.strip("/")][pair.key].append(float(pair.value))

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._rclpy.spin_once(self._node, timeout_sec=left)

    def close(self) -> None:
        self._node.destroy_node()
        self._rclpy.try_shutdown()


def own_megabytes(pid: int) -> float:
    """Memory of a process without files and shared memory."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) / 1024
    return 0.0


def growth(samples: Sequence[float]) -> float:
    """Median of the last fifth relative to that of the first fifth, minus one."""
    part = max(1, len(samples) // 5)
    first = median(samples[:part])
    return median(samples[-part:]) / first - 1 if first else 0.0


def delete_old_files(bag: Path, keep: int) -> None:
    """Delete the files of a bag that are finished, but the newest ones."""
    files = sorted(bag.glob("*.mcap"), key=lambda path: int(path.stem.rpartition("_")[2]))
    for path in files[: -keep - 1]:
        path.unlink()


def soak(options: argparse.Namespace, folder: Path) -> int:
    """Run and report; returns the exit code."""
    topics = [*(RAW if options.raw else COMPRESSED), *TRUTH]
    bag = folder / "soak"
    processes = scene_processes(options.scene, record=RecordOptions(bag, topics))
    processes[0] = _with(processes[0], rate=float(options.rate))
    processes[-1] = _with(processes[-1], max_bag_duration=60.0)
    cameras = [name for each in processes if each.renders for name in each.visible_nodes]
    prepare_transport(len(processes) + 1, network=False)
    memory: dict[str, list[float]] = defaultdict(list)
    rates, latencies = [], []
    diagnostics = Diagnostics()
    with Supervisor(processes) as nodes:
        for minute in range(-options.warm_up, options.minutes):
            diagnostics.values.clear()
            end = time.monotonic() + 60
            while time.monotonic() < end:
                diagnostics.spin(min(SAMPLE_EVERY, max(0.0, end - time.monotonic())))
                if dead := nodes.dead():
                    print(f"error: {dead}")
                    return 1
                for name, pid in nodes.pids.items():
                    if minute >= 0:
                        memory[name].append(own_megabytes(pid))
            delete_old_files(bag, options.keep)
            values = diagnostics.values
            seen = [name for name in cameras if values[name]["frames"]]
            rate = min((sum(values[name]["frames"]) / 60 for name in seen), default=0.0)
            late = [value for name in seen for value in values[name]["lateness_median_ms"]]
            latency = median(late) if late else 0.0
            recorder = values["recorder"]
            if minute >= 0:
                rates.append(rate)
                latencies.append(latency)
            now = {name: own_megabytes(pid) for name, pid in nodes.pids.items()}
            print(
                f"minute {minute + 1:3}: {rate:5.1f} frames/s, {latency:6.1f} ms, "
                f"{sum(recorder['messages']) / 60:6.1f} messages/s, {sum(recorder['drops']):.0f} drops; MB: "
                + ", ".join(f"{name} {value:.1f}" for name, value in now.items()),
                flush=True,
            )
    diagnostics.close()
    print(f"rate {growth(rates):+.1%}, latency {growth(latencies):+.1%}")
    grown = {name: growth(samples) for name, samples in memory.items()}
    for name, value in grown.items():
        print(f"{name:20} {memory[name][-1]:8.1f} MB {value:+.2%}")
    return int(any(value >= MAX_GROWTH for value in grown.values()))


def _with(process: Any, **parameters: Any) -> Any:
    from dataclasses import replace

    return replace(process, parameters={**process.parameters, **parameters})


def main() -> int:
    """Run the soak; returns its exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=int, default=30)
    parser.add_argument("--warm-up", type=int, default=5, help="minutes before the first sample")
    parser.add_argument("--scene", default=str(resource_path("config/scenes/demo.yaml")))
    parser.add_argument("--rate", type=float, default=10.0, help="frames per second of the player")
    parser.add_argument("--keep", type=int, default=3, help="finished files of the bag that are kept")
    parser.add_argument("--raw", action="store_true", help="record raw images")
    folder = Path(tempfile.mkdtemp(prefix="humansim_soak_"))
    try:
        return soak(parser.parse_args(), folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
