"""Live rates and latencies: all nodes of the demo scene as processes, and one subscriber.

    python benchmarks/live.py [--seconds 10] [--repeat 5] [--processes 1 2 4] [--table] [--json FILE]

A row for each set of topics: the lowest rate at which a topic reached the subscriber's callback, the share of
the player's frames that arrived, the share of complete frames (all topics of all cameras with one stamp), the
share of whole frames (image_raw of all cameras) among those of which any camera sent image_raw, the time from
a frame's stamp to the callback of image_raw, CPU time of nodes and subscriber per frame, and the number of
cores that other processes used meanwhile; figures mean little if these are many. Below: CPU time of each
process, and the times after the stamp at which a frame left each node, was complete at the cameras, and
reached the subscriber from each camera (medians). With ``--repeat``, medians of several runs. Frames that
arrive until 2 s after a run are counted.

``--busy N`` starts N processes that compute without end after the warm-up, as on a machine that is too slow:
frames should be fewer then, but whole.

The subscriber uses the executor of the nodes; with ``--plain-spin`` rclpy's default one, which takes 4 to 6
ms more CPU time per frame.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, MultiDOFJointState

from humansim_ros.data.messages import serialised_stamp
from humansim_ros.files.reading.assets import resource_path
from humansim_ros.files.reading.programs import cores
from humansim_ros.ros.graph.qos import DATA
from humansim_ros.ros.processes.node_processes import scene_processes
from humansim_ros.ros.processes.runtime import make_executor, prepare_transport
from humansim_ros.ros.processes.supervisor import Supervisor
from humansim_ros.ros.tools.bench import CpuTime
from humansim_ros.scene import Scene
from humansim_ros.scene.core.scene import DEMO_SCENE


@dataclass(frozen=True)
class Case:
    """Topics of each camera that the subscriber subscribes to, number and size of the cameras, and rate."""

    kinds: tuple[str, ...]
    cameras: int = 4
    size: tuple[int, int] = (640, 480)
    rate: float = 30.0


RGB_INFO = ("image_raw", "camera_info")
CASES = {
    "rgb": Case(("image_raw",)),
    "rgb + info": Case(RGB_INFO),
    "rgb + info + depth + part": Case((*RGB_INFO, "depth/image", "part/image")),
    "rgb, 8 cameras": Case(("image_raw",), 8),
    "rgb as JPEG": Case(("image_raw/compressed",)),
    "rgb + info, 12 cameras, 15 Hz": Case(RGB_INFO, 12, rate=15.0),
    "rgb + info, 1920x1080, 15 Hz": Case(RGB_INFO, size=(1920, 1080), rate=15.0),
}
MESSAGE_TYPES = {"camera_info": CameraInfo, "image_raw/compressed": CompressedImage}
#: Frames of every topic before a run: cameras render their static scene and adapt their stride.
WARM_UP = 100
#: Seconds that nodes have to adapt to busy processes.
SETTLING = 5.0
#: Nanoseconds after a run for which its last frames are awaited.
STRAGGLERS = 2_000_000_000
#: Heading and format of the figures of a run.
COLUMNS = {
    "lowest_hz": ("Hz", "6.1f"),
    "received": ("received", "9.1%"),
    "complete_frames": ("complete", "8.1%"),
    "whole_frames": ("whole", "7.1%"),
    "latency_ms_median": ("median", "8.1f"),
    "latency_ms_p99": ("p99 ms", "8.1f"),
    "cpu_ms_per_frame": ("CPU ms", "8.1f"),
    "other_cores": ("others", "7.2f"),
}


@dataclass(frozen=True)
class Setting:
    """Subscribed topics, number of camera processes, and options that differ from the defaults."""

    case: str
    processes: int
    lead: float | None = None
    plain_spin: bool = False

    @property
    def name(self) -> str:
        lead = "" if self.lead is None else f", lead {self.lead:g} s"
        return self.case + lead + (", rclpy.spin" if self.plain_spin else "")


#: The settings of docs/performance.md.
ALL_FOUR = "rgb + info + depth + part"
TABLE = (
    Setting("rgb", cores()),
    Setting(ALL_FOUR, cores()),
    Setting(ALL_FOUR, cores(), lead=0.0),
    Setting(ALL_FOUR, cores(), plain_spin=True),
    Setting(ALL_FOUR, 4),
    Setting(ALL_FOUR, 1),
    Setting("rgb as JPEG", cores()),
    Setting("rgb, 8 cameras", cores()),
    Setting("rgb + info, 12 cameras, 15 Hz", cores()),
    Setting("rgb + info, 1920x1080, 15 Hz", cores()),
)


def set_nice(pids: Iterable[int], nice: int) -> None:
    """Set the nice value of processes, and of their sessions: every node has a session of its own, and Linux
    schedules a session as a group.
    """
    for pid in pids:
        os.setpriority(os.PRIO_PROCESS, pid, nice)
        with suppress(OSError):
            Path(f"/proc/{pid}/autogroup").write_text(str(nice))


def scene_of(case: Case, folder: Path) -> Path:
    """Write the demo scene with the cameras of a case: some of its own, or more on a circle around it."""
    content = yaml.safe_load(resource_path(DEMO_SCENE).read_text())
    number, cameras = case.cameras, content["cameras"]
    for i in range(len(cameras), number):
        angle = 2 * np.pi * (i + 0.5) / (number - len(cameras))
        position = [round(float(x), 3) for x in (3.2 * np.cos(angle), 2.9 * np.sin(angle), 2.0)]
        cameras[f"camera_{i + 1}"] = {**next(iter(cameras.values())), "position": position}
    chosen = list(cameras.items())[:number]
    content |= {
        "rate": case.rate,
        "cameras": {name: {**own, "size": list(case.size)} for name, own in chosen},
    }
    changed = folder / f"{number}_cameras_{case.size[0]}_{case.rate:g}.yaml"
    changed.write_text(yaml.safe_dump(content, sort_keys=False))
    return changed


def compute_for_ever() -> None:
    while True:
        pass


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Keep ``count`` processes computing."""
    loops = [multiprocessing.Process(target=compute_for_ever, daemon=True) for _ in range(count)]
    for loop in loops:
        loop.start()
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()


def measure(setting: Setting, folder: Path, seconds: float, nice: int, loops: int) -> dict[str, Any]:
    """Run the nodes and the subscriber with a setting for some seconds.

    Args:
        setting: Subscribed topics, and options of the nodes.
        folder: Folder for scene files.
        seconds: Length of the run.
        nice: Nice value of all processes.
        loops: Number of processes that compute without end meanwhile.

    Returns:
        Figures of the run, see COLUMNS.
    """
    kinds = CASES[setting.case].kinds
    scene = scene_of(CASES[setting.case], folder)
    cameras = list(Scene.load(scene).cameras)
    executor = SingleThreadedExecutor() if setting.plain_spin else make_executor()
    node = rclpy.create_node("live_benchmark")
    executor.add_node(node)
    player: dict[str, Any] = {} if setting.lead is None else {"lead": setting.lead}
    arrived: dict[str, dict[int, float]] = defaultdict(dict)
    diagnostics: dict[str, list[float]] = defaultdict(list)

    def callback(topic: str) -> Any:
        def on_message(data: bytes) -> None:
            now = time.time_ns()
            stamp = serialised_stamp(data)
            arrived[topic][stamp] = (now - stamp) * 1e-6

        return on_message

    def on_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            for event in ("arrival", "lateness"):
                if f"{event}_median_ms" in values:
                    diagnostics[f"{event} {status.name[1:]}"].append(float(values[f"{event}_median_ms"]))

    for camera in cameras:
        for kind in kinds:
            topic = f"/{camera}/{kind}"
            message = MESSAGE_TYPES.get(kind, Image)
            node.create_subscription(message, topic, callback(topic), qos_profile_sensor_data, raw=True)
    node.create_subscription(MultiDOFJointState, "/humans/walker/motion", callback("motion"), DATA, raw=True)
    node.create_subscription(DiagnosticArray, "/diagnostics", on_diagnostics, DATA)
    topics = [f"/{camera}/{kind}" for camera in cameras for kind in kinds]
    started = [
        replace(process, parameters={**process.parameters, **player})
        if process.executable == "motion_player"
        else process
        for process in scene_processes(scene, setting.processes)
    ]
    with Supervisor(started) as nodes:
        running = {"subscriber": os.getpid(), **nodes.pids}
        if nice:
            set_nice(running.values(), nice)
        limit = time.monotonic() + 60
        while any(len(arrived[topic]) < WARM_UP for topic in topics):
            executor.spin_once(timeout_sec=0.05)
            if nodes.dead() or time.monotonic() > limit:
                raise SystemExit(
                    f"no images on {[t for t in topics if not arrived[t]]}; dead node: {nodes.dead()}"
                )
        with busy(loops):
            settled = time.monotonic() + (SETTLING if loops else 0.0)
            while time.monotonic() < settled:
                executor.spin_once(timeout_sec=0.05)
            diagnostics.clear()
            begin, before = time.time_ns(), CpuTime.now(running)
            end = begin + round(1e9 * seconds)
            while time.time_ns() < end:
                executor.spin_once(timeout_sec=0.05)
            used = CpuTime.now(running).since(before)
            while time.time_ns() < end + STRAGGLERS:
                executor.spin_once(timeout_sec=0.05)
    executor.shutdown()
    node.destroy_node()
    arrived = {topic: {s: ms for s, ms in at.items() if begin <= s < end} for topic, at in arrived.items()}
    played = max(1, len(arrived["motion"]))
    counts = {topic: len(arrived[topic]) for topic in topics}
    complete = set.intersection(*(set(arrived[topic]) for topic in topics))
    images = [set(arrived[f"/{camera}/{kinds[0]}"]) for camera in cameras]
    latencies = np.array([ms for camera in cameras for ms in arrived[f"/{camera}/{kinds[0]}"].values()])
    cpu = used.processes
    stages = {"motion": arrived["motion"], **{name: arrived[f"/{name}/{kinds[0]}"] for name in cameras}}
    return {
        "lowest_hz": min(counts.values()) / seconds,
        "received": min(counts.values()) / played,
        "complete_frames": len(complete) / played,
        "whole_frames": len(set.intersection(*images)) / max(1, len(set.union(*images))),
        "latency_ms_median": float(np.median(latencies)),
        "latency_ms_p99": float(np.percentile(latencies, 99)),
        "cpu_ms_per_frame": 1e3 * sum(cpu.values()) / played,
        "other_cores": (used.machine - used.total) / seconds,
        "cpu_ms": {name: 1e3 * used / played for name, used in cpu.items()},
        "after_stamp_ms": {
            **{name: float(np.median(times)) for name, times in diagnostics.items()},
            **{f"received {name}": float(np.median(list(times.values()))) for name, times in stages.items()},
        },
    }


def medians(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Median of every figure of several runs."""
    return {
        key: medians([run[key] for run in runs])
        if isinstance(value, dict)
        else float(np.median([run[key] for run in runs]))
        for key, value in runs[0].items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--repeat", type=int, default=1, help="runs of each setting, in turn")
    parser.add_argument(
        "--processes", type=int, nargs="+", help="numbers of camera processes; one per core if absent"
    )
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument(
        "--plain-spin",
        action="store_true",
        help="the subscriber uses the default executor of rclpy.spin",
    )
    parser.add_argument(
        "--lead", type=float, help="lead of the motion player in seconds; the default if absent"
    )
    parser.add_argument("--table", action="store_true", help="settings of docs/performance.md, and its table")
    parser.add_argument("--nice", type=int, default=0, help="nice value of all processes; below 0 needs root")
    parser.add_argument("--busy", type=int, default=0, help="processes that compute without end meanwhile")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    settings = [
        Setting(case, processes or cores(), arguments.lead, arguments.plain_spin)
        for processes in arguments.processes or [None]
        for case in arguments.cases
    ]
    prepare_transport()
    rclpy.init()
    runs: dict[Setting, list[dict[str, Any]]] = defaultdict(list)
    print(f"{cores()} cores, demo scene at 640x480, 30 Hz unless named, {arguments.seconds:g} s each")
    print(f"{'subscribed, per camera':42} processes", *(heading(*c) for c in COLUMNS.values()))
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(arguments.repeat):
            for setting in TABLE if arguments.table else settings:
                runs[setting].append(
                    measure(setting, Path(folder), arguments.seconds, arguments.nice, arguments.busy)
                )
                print(row(setting, runs[setting][-1]), flush=True)
    rclpy.try_shutdown()
    print(f"\nmedians of {arguments.repeat}")
    results = {setting: medians(runs_of_setting) for setting, runs_of_setting in runs.items()}
    for setting, result in results.items():
        print(row(setting, result))
        for group in ("cpu_ms", "after_stamp_ms"):
            print(f"    {group}:", ", ".join(f"{name} {ms:.1f}" for name, ms in result[group].items()))
    if arguments.table:
        print(
            "\n| subscribed, per camera | processes | Hz | received | complete | median | p99 | CPU a frame |"
        )
        print("|---|---|---|---|---|---|---|---|")
        for setting, result in results.items():
            print(table_row(setting, result))
    if arguments.json:
        named = {f"{setting.name}, {setting.processes} processes": r for setting, r in results.items()}
        arguments.json.write_text(json.dumps(named, indent=2))


def heading(name: str, form: str) -> str:
    return f"{name:>{form.split('.')[0]}}"


def row(setting: Setting, result: dict[str, Any]) -> str:
    numbers = " ".join(f"{result[key]:{form}}" for key, (_, form) in COLUMNS.items())
    return f"{setting.name:42} {setting.processes:9} {numbers}"


def table_row(setting: Setting, r: dict[str, Any]) -> str:
    return (
        f"| {setting.name} | {setting.processes} | {r['lowest_hz']:.1f} | {r['received']:.1%} "
        f"| {r['complete_frames']:.1%} | {r['latency_ms_median']:.0f} ms | {r['latency_ms_p99']:.0f} ms "
        f"| {r['cpu_ms_per_frame']:.1f} ms |"
    ).replace("%", " %")


if __name__ == "__main__":
    main()
