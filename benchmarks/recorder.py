"""Recorder of a live graph: share of the messages that it records, its processor time, and bytes per second.

    python benchmarks/recorder.py [--seconds 60] [--rate 10]

Runs the demo scene (four cameras of 640x480) in real time with a recorder of image_raw and joints of all
cameras.
A frame that the player has sent, known from /scene_time, is recorded if its message is in the bag; frames
count in the measured seconds. The processor time is compared with that of all nodes in the same run.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from humansim_ros.data.bags.reader import BagReader  # noqa: E402
from humansim_ros.files.reading.assets import resource_path  # noqa: E402
from humansim_ros.ros.processes.node_processes import scene_processes  # noqa: E402
from humansim_ros.ros.processes.run_options import RecordOptions  # noqa: E402
from humansim_ros.ros.processes.runtime import prepare_transport  # noqa: E402
from humansim_ros.ros.processes.supervisor import Supervisor  # noqa: E402
from humansim_ros.ros.tools.bench import CpuTime  # noqa: E402

TOPICS = ("/scene_time", "/camera_*/image_raw", "/camera_*/joints")
#: Longest start of the nodes, seconds.
START = 120.0


def size_of(bag: Path) -> int:
    """Bytes of the files of a bag."""
    return sum(path.stat().st_size for path in bag.glob("*.mcap"))


def run(seconds: float, rate: float, bag: Path) -> CpuTime:
    """Record for some seconds; returns the processor time of all nodes in them."""
    scene = resource_path("config/scenes/demo.yaml")
    processes = scene_processes(scene, record=RecordOptions(bag, TOPICS))
    processes[0] = replace(processes[0], parameters={**processes[0].parameters, "rate": rate})
    prepare_transport(len(processes), network=False)
    with Supervisor(processes) as nodes:
        limit = time.monotonic() + START
        while size_of(bag) < 20_000_000 and time.monotonic() < limit:
            time.sleep(0.2)
        before = CpuTime.now(nodes.pids)
        time.sleep(seconds)
        return CpuTime.now(nodes.pids).since(before)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=10.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        used = run(options.seconds, options.rate, bag)
        stamps: dict[str, set[int]] = defaultdict(set)
        size = 0
        with BagReader(bag) as reader:
            for message in reader.messages():
                stamps[reader.topics[message.topic].name].add(message.published or message.stamp)
                size += len(message.data)
            info = reader.info
    frames = stamps.pop("/scene_time")
    end = min(map(max, stamps.values()))
    begin = end - options.seconds * 1e9  # before, the cameras prepare their first frames
    sent = {stamp for stamp in frames if begin <= stamp <= end}
    length = (info.end - info.start) * 1e-9 if info.start is not None and info.end is not None else 1.0
    for topic, received in sorted(stamps.items()):
        print(f"{topic:28} {len(received & sent):6} of {len(sent)} frames recorded")
    recorder = used.processes["recorder"]
    print(f"{size / length / 1e6:.1f} MB/s, {info.messages / length:.0f} messages/s")
    print(
        f"processor time of the recorder: {recorder / options.seconds:.1%} of a core, "
        f"{recorder / used.total:.1%} of all nodes"
    )


if __name__ == "__main__":
    main()
