"""Kill processes of a run in lockstep at random, and count the frames that a tracker has not got.

    python tools/chaos.py [SCENE] [--kills 20] [--stops 2] [--seed 1] [--processes 2] [--record BAG]

Victims are the motion player, the skinners, the camera processes, the recorder and the tracker
(``tools/slow_tracker.py``), in turn and in random order: ``kill -9``, and SIGSTOP for 5 s. ``humansim run``
starts its nodes again, this program the tracker. After each, frames must go on. At the end the tracker must
have every stamp from frame 0 to its newest one, in this order; and with ``--record`` each recorded topic of
all frames must have them, too. Exit code 1: a frame is lost, stamps went back, or frames did not go on.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")

from kill_nodes import node_pid
from slow_tracker import tracked_stamps

from humansim_ros.data.bags.reader import BagReader
from humansim_ros.files.reading.assets import resource_path
from humansim_ros.ros.processes.lockstep_settings import TimeOptions
from humansim_ros.ros.processes.node_processes import scene_processes
from humansim_ros.ros.processes.run_options import RecordOptions
from humansim_ros.scene import Scene

ROOT = Path(__file__).resolve().parents[1]
#: Shortest and longest time between two faults, and the time for which a process is stopped, seconds.
PAUSE, STOPPED = (1.0, 6.0), 5.0
#: Frames after a fault until the next one.
FRAMES_BETWEEN = 5
TRACKER = "tracker"


class Chaos:
    """``humansim run --lockstep`` of a scene with a tracker.

    Args:
        scene: Scene file.
        processes: Number of camera processes; one per core if None.
        log: File for the stamps of the tracker.
        limit: Seconds until frames must go on.
        bag: Folder of a bag to record; none if None.
    """

    def __init__(
        self, scene: Path, processes: int | None, log: Path, limit: float, bag: Path | None = None
    ) -> None:
        self._log, self._limit = log, limit
        self._cameras = list(Scene.load(scene).cameras)
        recorded = RecordOptions(bag) if bag else None
        found = scene_processes(scene, processes, time=TimeOptions(lockstep=True), record=recorded)
        self.victims = [*(each.node_name for each in found), TRACKER]
        options = [] if processes is None else ["--jobs", str(processes)]
        options += ["--record", str(bag)] if bag else []
        members = ["--wait-for", "topic:/tracker/poses", "--timeout", str(limit)]
        command = [sys.executable, "-m", "humansim_ros.cli", "run", str(scene), "--lockstep", *members]
        self.run = subprocess.Popen([*command, *options], env={**os.environ, "PYTHONPATH": str(ROOT)})
        self._tracker = self._start_tracker()

    def _start_tracker(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, str(ROOT / "tools" / "slow_tracker.py"), str(self._log), *self._cameras]
        return subprocess.Popen([*command, "--sleep", "0.02"])

    @property
    def times_back(self) -> int:
        """How often a stamp of the tracker was before the one before it."""
        stamps = [int(line.split()[0]) for line in self._log.read_text().splitlines() if line.count(" ") == 2]
        return sum(later < earlier for earlier, later in pairwise(stamps))

    @property
    def tracked(self) -> list[int]:
        """Stamps that the tracker has had."""
        return tracked_stamps(self._log)

    def wait_for_frames(self, frames: int = FRAMES_BETWEEN) -> None:
        """Wait until the tracker has had some more frames. Raises RuntimeError if it gets none."""
        newest = len(self.tracked) + frames
        if not self._wait_until(lambda: len(self.tracked) >= newest):
            raise RuntimeError(f"the frames do not go on after frame {len(self.tracked) - 1}")

    def fault(self, victim: str, number: signal.Signals) -> float:
        """Kill or stop a process. Returns seconds until frames went on."""
        pid = self._pid(victim)
        begin = time.monotonic()
        os.kill(pid, number)
        if number == signal.SIGSTOP:
            time.sleep(STOPPED)
            os.kill(pid, signal.SIGCONT)
        elif victim == TRACKER:
            self._tracker.wait()
            self._tracker = self._start_tracker()
        self.wait_for_frames()
        return time.monotonic() - begin

    def _pid(self, victim: str) -> int:
        if victim == TRACKER:
            return self._tracker.pid
        found: list[int] = []

        def is_found() -> bool:
            found.extend(filter(None, [node_pid(self.run.pid, victim)]))
            return bool(found)

        if not self._wait_until(is_found):
            raise RuntimeError(f"{victim} does not run")
        return found[0]

    def _wait_until(self, done: Callable[[], bool]) -> bool:
        end = time.monotonic() + self._limit
        while not done():
            if time.monotonic() > end or self.run.poll() is not None:
                return False
            time.sleep(0.05)
        return True

    def close(self) -> None:
        """Stop everything."""
        for process in (self.run, self._tracker):
            with suppress(ProcessLookupError):
                process.send_signal(signal.SIGINT)
        for process in (self.run, self._tracker):
            with suppress(subprocess.TimeoutExpired):
                process.wait(30)
            process.kill()


def lost_frames(stamps: list[int], rate: float) -> list[int]:
    """Numbers of the frames, from 0 to the newest one, whose stamp is missing."""
    newest = round((stamps[-1] - 1) * rate * 1e-9) if stamps else 0
    had = set(stamps)
    return [number for number in range(newest + 1) if 1 + round(number * 1e9 / rate) not in had]


def incomplete_topics(bag: Path, stamps: list[int]) -> dict[str, tuple[int, int]]:
    """Topics of a bag that have other stamps than all of ``stamps``, each once: lacking, more than once.

    Only topics are compared that have a message for most of the stamps: others are not in every frame.
    """
    times: dict[str, list[int]] = {}
    with BagReader(bag) as reader:
        for message in reader.messages():
            stamp = message.stamp if message.published is None else message.published
            times.setdefault(reader.topics[message.topic].name, []).append(stamp)
    found = {}
    for topic, published in times.items():
        lacking = len(set(stamps) - set(published))
        repeated = len(published) - len(set(published))
        if lacking < len(stamps) / 2 and (lacking or repeated):
            found[topic] = lacking, repeated
    print(f"{sum(map(len, times.values()))} messages of {len(times)} topics in {bag}")
    return found


def main() -> int:
    """Kill, and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", nargs="?", type=Path, default=resource_path("config/scenes/demo.yaml"))
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--stops", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, help="camera processes; default: one per core")
    parser.add_argument("--record", type=Path, metavar="BAG", help="record into this folder")
    parser.add_argument("--limit", type=float, default=120.0, help="seconds until frames must go on")
    options = parser.parse_args()
    choice = random.Random(options.seed)
    rate = Scene.load(options.scene).config.rate
    failed = ""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "tracked")
        chaos = Chaos(options.scene, options.processes, log, options.limit, options.record)
        faults = [signal.SIGKILL] * options.kills + [signal.SIGSTOP] * options.stops
        order: list[str] = []
        while len(order) < len(faults):
            order += choice.sample(chaos.victims, len(chaos.victims))
        choice.shuffle(faults)
        try:
            chaos.wait_for_frames()
            for victim, number in zip(order, faults, strict=False):
                time.sleep(choice.uniform(*PAUSE))
                seconds = chaos.fault(victim, number)
                print(f"{number.name} {victim:24} frames went on after {seconds:5.1f} s", flush=True)
        except RuntimeError as error:
            failed = str(error)
        finally:
            chaos.close()
        stamps, back = chaos.tracked, chaos.times_back
    lost = lost_frames(stamps, rate)
    print(failed or f"{len(faults)} faults: {len(stamps)} frames tracked, {len(lost)} lost {lost[:20]}")
    print(f"stamps went back {back} times")
    incomplete = incomplete_topics(options.record, stamps) if options.record else {}
    for topic, (lacking, repeated) in incomplete.items():
        print(f"{topic}: {lacking} frames lost, {repeated} repeated")
    return 1 if failed or lost or back or incomplete else 0


if __name__ == "__main__":
    sys.exit(main())
