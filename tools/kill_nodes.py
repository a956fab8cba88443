"""Kill node processes of ``humansim run`` at random, and measure when each is back.

    python tools/kill_nodes.py [SCENE] [--kills 20] [--seed 1] [--processes 2]

After each ``kill -9``, a late subscriber waits for all topics of the process: ``latched`` says when it had
every latched message of the new process, ``back`` when data flowed on every topic too, and ``cpu`` how much
CPU time the process needed for that, which depends little on the load of the machine. ``others`` is the
longest gap between messages of the topics that do not depend on the process: bodies for a camera process, and
images of the other camera processes; motions for a skinner. Exit code 1: a process was not back within the
limit, another process ended, or a process is left at the end.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

import rclpy
from geometry_msgs.msg import TransformStamped
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, MultiDOFJointState, PointCloud2
from shape_msgs.msg import Mesh
from std_msgs.msg import Float64MultiArray, String

from humansim_ros.files.reading.assets import resource_path
from humansim_ros.ros.graph.qos import LATCHED
from humansim_ros.ros.processes.node_processes import NodeProcess, scene_processes
from humansim_ros.ros.processes.runtime import make_executor, prepare_transport
from humansim_ros.ros.processes.stop_signals import children_of
from humansim_ros.scene.core.names import skinner_node

#: Shortest and longest time between a return and the next kill, seconds.
PAUSE = (4.0, 12.0)
#: Latched and other topics of a camera.
LATCHED_OF_CAMERAS = {
    "instance/legend": String,
    "part/legend": String,
    "joints/legend": String,
    "extrinsics": TransformStamped,
    "projection": Float64MultiArray,
}
FLOWING_OF_CAMERAS = {"camera_info": CameraInfo, "image_raw": Image}
FLOWING_OF_HUMANS = {"joints": MultiDOFJointState, "vertices": PointCloud2}


@dataclass(frozen=True)
class Victim:
    """A process, its topics by type, and the topics that go on without it.

    Attributes:
        process: The process.
        latched: Latched topics.
        flowing: Topics with data in every frame.
        independent: Topics of other processes that need nothing of it.
    """

    process: NodeProcess
    latched: Mapping[str, Any]
    flowing: Mapping[str, Any]
    independent: Sequence[str]

    @property
    def name(self) -> str:
        """Names of its nodes."""
        return ", ".join(self.process.visible_nodes)


@dataclass
class Kill:
    """Outcome of a kill.

    Attributes:
        name: Names of the nodes that were killed.
        process: Seconds until the new process ran.
        latched: Seconds until a late subscriber had all latched messages.
        back: Seconds until it had data of all topics.
        others: Longest gap in the topics that do not depend on the process, seconds; None if all do.
        cpu: Seconds of CPU time that the new process needed until then.
        missing: Topics on which nothing arrived.
        ended: Process ids of others that ended meanwhile.
    """

    name: str
    process: float = float("nan")
    latched: float = float("nan")
    back: float = float("nan")
    others: float | None = None
    cpu: float = float("nan")
    missing: list[str] = field(default_factory=list)
    ended: list[int] = field(default_factory=list)


def humans_of(process: NodeProcess) -> list[str]:
    """Humans that a process skins."""
    if process.executable not in ("skinner", "skinner_rig"):
        return []
    return [name.removeprefix(skinner_node("")) for name in process.visible_nodes]


def victims_of(scene: Path, processes: int | None) -> list[Victim]:
    """All processes of a scene with their topics."""
    found = scene_processes(scene, processes)
    humans = {each.node_name: humans_of(each) for each in found}
    motions = {f"/humans/{name}/motion": MultiDOFJointState for names in humans.values() for name in names}
    flowing: dict[str, dict[str, Any]] = {"motion_player": motions}
    latched: dict[str, dict[str, Any]] = {
        "motion_player": {f"{motion}/legend": String for motion in motions},
    }
    for each in found:
        if names := humans[each.node_name]:
            latched[each.node_name], flowing[each.node_name] = (
                {f"/humans/{human}/{name}": kind for human in names for name, kind in topics.items()}
                for topics in ({"mesh": Mesh}, FLOWING_OF_HUMANS)
            )
        elif each.executable != "motion_player":
            latched[each.node_name], flowing[each.node_name] = (
                {f"/{camera}/{name}": kind for camera in each.visible_nodes for name, kind in topics.items()}
                for topics in (LATCHED_OF_CAMERAS, FLOWING_OF_CAMERAS)
            )
    # a camera needs all skinners, and a skinner needs the player
    rank = {"motion_player": 0, "skinner": 1, "skinner_rig": 1}
    return [
        Victim(
            each,
            latched[each.node_name],
            flowing[each.node_name],
            [
                topic
                for other in found
                if other != each and rank.get(other.executable, 2) <= rank.get(each.executable, 2)
                for topic in flowing[other.node_name]
            ],
        )
        for each in found
    ]


class Suite:
    """``humansim run`` of a scene, and a subscriber to all topics with data."""

    def __init__(self, scene: Path, processes: int | None, limit: float) -> None:
        """``limit``: seconds until a process counts as lost."""
        self._limit = limit
        self.victims = victims_of(scene, processes)
        options = [] if processes is None else ["--jobs", str(processes)]
        self.run = subprocess.Popen([sys.executable, "-m", "humansim_ros.cli", "run", str(scene), *options])
        prepare_transport()
        rclpy.init(args=[])
        self._executor = make_executor()
        self._node = rclpy.create_node("kill_nodes")
        self._executor.add_node(self._node)
        self._arrivals: dict[str, list[float]] = {}
        for victim in self.victims:
            self._subscribe(self._node, victim.flowing, self._arrivals, qos_profile_sensor_data)

    def close(self) -> list[int]:
        """Stop the run; returns the process ids of children that are left."""
        pids = self.children()
        self.run.send_signal(signal.SIGINT)
        self.run.wait(self._limit)
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown()
        return [pid for pid in pids if Path(f"/proc/{pid}").exists()]

    def children(self) -> list[int]:
        """Process ids of the children of the run."""
        return descendants_of(self.run.pid)

    def pid(self, victim: Victim) -> int | None:
        """Process id of a victim; None if it does not run."""
        return node_pid(self.run.pid, victim.process.node_name)

    def wait_for_data(self) -> None:
        """Wait until data has arrived on all topics. Raises RuntimeError if it does not arrive."""
        self._arrivals.clear()
        topics = {topic for victim in self.victims for topic in victim.flowing}
        if not self._spin_until(lambda: topics <= self._arrivals.keys()):
            raise RuntimeError(f"nothing arrives on {', '.join(sorted(topics - self._arrivals.keys()))}")

    def spin(self, seconds: float) -> None:
        """Receive messages for some seconds."""
        end = time.monotonic() + seconds
        self._spin_until(lambda: time.monotonic() > end)

    def kill(self, victim: Victim) -> Kill:
        """Kill a process, and wait until it is back."""
        killed = self.pid(victim)
        assert killed is not None, victim.name
        others = {pid: cpu_seconds(pid) for pid in self.children() if pid != killed}
        self._arrivals.clear()
        outcome = Kill(victim.name)
        late = rclpy.create_node("late_subscriber")
        begin = time.monotonic()
        os.kill(killed, signal.SIGKILL)
        arrived: dict[str, list[float]] = {}
        # the messages of the old process that are on their way do not reach these subscriptions
        self._subscribe(late, victim.latched, arrived, LATCHED)
        self._subscribe(late, victim.flowing, arrived, qos_profile_sensor_data)
        self._executor.add_node(late)
        topics = {*victim.latched, *victim.flowing}

        def is_back() -> bool:
            if outcome.process != outcome.process and self.pid(victim) not in (None, killed):
                outcome.process = time.monotonic() - begin
            return topics <= arrived.keys()

        self._spin_until(is_back)
        outcome.missing = sorted(topics - arrived.keys())
        if not outcome.missing:
            outcome.latched = max(arrived[topic][0] for topic in victim.latched) - begin
            outcome.back = max(times[0] for times in arrived.values()) - begin
        if (new := self.pid(victim)) is not None:  # a spare process has used time before
            outcome.cpu = cpu_seconds(new) - others.get(new, 0.0)
        outcome.ended = [pid for pid in others if pid not in self.children()]
        if victim.independent:
            end = time.monotonic()
            outcome.others = max(
                longest_gap([begin, *self._arrivals.get(topic, ()), end]) for topic in victim.independent
            )
        self._executor.remove_node(late)
        late.destroy_node()
        return outcome

    def _subscribe(
        self, node: Any, topics: Mapping[str, Any], arrivals: dict[str, list[float]], qos: Any
    ) -> None:
        for topic, kind in topics.items():
            node.create_subscription(
                kind,
                topic,
                lambda _, topic=topic: arrivals.setdefault(topic, []).append(time.monotonic()),
                qos,
                raw=True,
            )

    def _spin_until(self, done: Callable[[], bool]) -> bool:
        end = time.monotonic() + self._limit
        while not done():
            if time.monotonic() > end or self.run.poll() is not None:
                return False
            self._executor.spin_once(0.02)
        return True


def descendants_of(run: int) -> list[int]:
    """Process ids of the children of a run, and of their children; none if it has ended."""
    pids = sorted(children_of(run))
    return pids + [pid for child in pids for pid in descendants_of(child)]


def node_pid(run: int, name: str) -> int | None:
    """Process id of a node of a run; None if it does not run."""
    for pid in descendants_of(run):
        with suppress(OSError):
            folder = Path(f"/proc/{pid}")
            if (folder / "comm").read_text().strip() == name[:15]:  # Linux keeps 15 letters
                return pid
    return None


def cpu_seconds(pid: int) -> float:
    """CPU time that a process has used."""
    values = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(values[11]) + int(values[12])) / os.sysconf("SC_CLK_TCK")


def longest_gap(times: Sequence[float]) -> float:
    """Longest time between two neighbours, seconds."""
    return max(later - earlier for earlier, later in pairwise(times))


def kill_at_random(suite: Suite, kills: int, seed: int) -> tuple[list[Kill], list[int]]:
    """Kill the processes of a run at random, and stop it.

    ``kills``: number of kills, which go round all processes. ``seed``: of order and pauses.

    Returns:
        Outcomes, and process ids of nodes that were left at the end.
    """
    choice = random.Random(seed)
    order: list[Victim] = []
    while len(order) < kills:
        order += choice.sample(suite.victims, len(suite.victims))
    outcomes = []
    try:
        for victim in order[:kills]:
            suite.wait_for_data()
            suite.spin(choice.uniform(*PAUSE))
            outcomes.append(suite.kill(victim))
            print(row(outcomes[-1]), flush=True)
    finally:
        left = suite.close()
    return outcomes, left


HEADING = f"{'nodes':34} process  latched    back     cpu   others   load"


def row(kill: Kill) -> str:
    """Line of a table."""
    others = "       " if kill.others is None else f"{kill.others:6.2f}s"
    times = f"{kill.process:6.2f}s {kill.latched:7.2f}s {kill.back:6.2f}s {kill.cpu:6.2f}s"
    faults = f"  nothing on {', '.join(kill.missing)}" if kill.missing else ""
    faults += f"  ended: {kill.ended}" if kill.ended else ""
    return f"{kill.name:34} {times}  {others} {os.getloadavg()[0]:6.1f}{faults}"


def main() -> int:
    """Kill, and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", type=Path, default=resource_path("config/scenes/demo.yaml"))
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, help="camera processes; default: one per core")
    parser.add_argument("--limit", type=float, default=60.0, help="seconds until a process counts as lost")
    options = parser.parse_args()
    print(HEADING)
    suite = Suite(options.scene, options.processes, options.limit)
    outcomes, left = kill_at_random(suite, options.kills, options.seed)
    back = [outcome.back for outcome in outcomes if not outcome.missing and not outcome.ended]
    print(f"{len(back)} of {len(outcomes)} back; median {median(back):.2f} s, longest {max(back):.2f} s")
    print(f"left at the end: {left or 'nothing'}")
    return 1 if left or len(back) < options.kills else 0


if __name__ == "__main__":
    sys.exit(main())
