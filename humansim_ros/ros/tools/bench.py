"""``humansim bench``: measure how many cameras of a scene this machine can run, with the nodes of a real
run."""

from __future__ import annotations

import math
import os
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import Image

from humansim_ros.data.messages import Frames, serialised_stamp
from humansim_ros.errors import HumansimError, RosError, unknown
from humansim_ros.files.reading import cores
from humansim_ros.render.interface import CHANNEL_TABLE
from humansim_ros.ros.processes.lockstep_settings import TimeOptions
from humansim_ros.ros.processes.node_processes import NodeProcess, scene_processes
from humansim_ros.ros.processes.runtime import prepare_transport
from humansim_ros.ros.processes.supervisor import Supervisor
from humansim_ros.ros.tools.listener import Listener
from humansim_ros.scene.core import Scene, SceneCamera

#: Frames per second that the motion player tries to send. Cameras cannot render so many, so they work at full
#: speed.
_RATE = 200.0
#: Share of the measured rate that the machine can keep up for a long time, with some other work going on.
_SHARE = 0.9
#: Most frames that are held while some of their images have not arrived.
_MAX_INCOMPLETE = 1000
#: Seconds between the first frame of all cameras and a measurement.
_SETTLING = 1.0
#: After the start, each topic must send a first message within this time, seconds.
_START_LIMIT = 90.0
#: If other processes use more cores than this, a measurement means little.
_BUSY_CORES = 0.25


@dataclass(frozen=True)
class BenchResult:
    """Rate at which a machine renders the cameras of a scene.

    Attributes:
        cameras: Milliseconds that each camera needs to render and send a frame, by name.
        pictures: Mean number of images per frame, lower than the number of cameras if some have their own
            rate.
        channels: Rendered channels.
        rate: Frames per second of the scene.
        measured_hz: Measured frames per second, counting frames with all channels of all cameras.
        frame_ms: CPU milliseconds per frame for everything except cameras: motions, bodies and subscriber.
        camera_ms: CPU milliseconds per image of one camera.
        processes: Number of camera processes.
        cores: Number of cores.
        other_cores: Number of cores that other processes used during the measurement.
    """

    cameras: dict[str, float]
    pictures: float
    channels: tuple[str, ...]
    rate: float
    measured_hz: float
    frame_ms: float
    camera_ms: float
    processes: int
    cores: int
    other_cores: float

    @property
    def max_hz(self) -> float:
        """Frames per second that the machine can keep up with these cameras."""
        return _SHARE * self.measured_hz

    @property
    def max_cameras(self) -> int:
        """Estimated number of such cameras that the machine can run at the rate of the scene."""
        if self.max_hz <= 0 or self.camera_ms <= 0:
            return 0
        # the time for a frame is taken as proportional to its CPU time
        frame = (self.frame_ms + self.pictures * self.camera_ms) * self.max_hz / self.rate
        return max(0, int((frame - self.frame_ms) / self.camera_ms + 1e-9))

    @property
    def holds(self) -> bool:
        """Whether the machine can run these cameras at the rate of the scene."""
        return self.max_hz >= self.rate

    def to_dict(self) -> dict[str, Any]:
        """Values for JSON."""
        derived = {name: getattr(self, name) for name in ("holds", "max_hz", "max_cameras")}
        return {**asdict(self), "channels": list(self.channels), **derived}

    def text(self) -> str:
        """Result as lines of text for users."""
        count, rate = len(self.cameras), f"{self.rate:g} Hz"
        holds = "holds" if self.holds else "does not hold"
        these = f"these {count}" if count > 1 else "this one"
        names = f"{', '.join(self.channels)} of all cameras"
        most = f"{self.max_hz:.{0 if self.max_hz >= 10 else 1}f}"
        lines = [
            f"this machine {holds} {_cameras(count)} at {rate}",
            f"at {rate} up to {_cameras(self.max_cameras)}; {these} at up to {most} Hz",
            f"measured: {self.measured_hz:.1f} Hz with {names}; a tenth of it is kept free",
            f"on {self.cores} cores with {self.processes} camera processes; milliseconds per frame: "
            + ", ".join(f"{name} {ms:.1f}" for name, ms in self.cameras.items()),
        ]
        if self.other_cores > _BUSY_CORES:
            lines.append(
                f"other processes used {self.other_cores:.1f} of the {self.cores} cores meanwhile: without "
                "them, the machine holds more"
            )
        return "\n".join(lines)


def _cameras(count: int) -> str:
    return f"{count} camera{'' if count == 1 else 's'}"


def topics_of(scene: Scene, channels: Sequence[str]) -> list[str]:
    """Image topics of all cameras for some channels. Raises HumansimError for an unknown channel."""
    topics = []
    for channel in channels:
        if channel not in CHANNEL_TABLE:
            raise HumansimError(unknown("channel", channel, CHANNEL_TABLE))
        name, bodies = CHANNEL_TABLE[channel].topic, list(scene.labels)
        of_bodies = [name.format(body=body) for body in bodies] if CHANNEL_TABLE[channel].per_body else [name]
        topics += [f"/{camera}/{topic}" for camera in scene.cameras for topic in of_bodies]
    return topics


def measure(
    path: Path,
    channels: Sequence[str],
    seconds: float,
    processes: int | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> BenchResult:
    """Run the nodes of a scene as fast as they can, with one subscriber, for some seconds.

    If this is slower than the rate of the scene, the nodes run once more at this rate: nodes that get too
    many frames waste time on frames that other nodes skip.

    Args:
        path: Scene file.
        channels: Channels to render.
        seconds: Length of the measurement.
        processes: Number of camera processes. If None, one per core.
        report: Prints a line of progress.

    Raises:
        HumansimError: The scene or a channel is wrong, a node ended, or a topic sends nothing.
    """
    bench = _Bench(Scene.load(path), path, channels, seconds, processes, report)
    rate = bench.scene.config.rate
    fast = bench.at(_RATE)
    if fast.measured_hz >= rate:
        return fast
    report(f"they do not reach {rate:g} Hz: starting them again, at this rate")
    return max(fast, bench.at(rate), key=lambda result: result.measured_hz)


@dataclass(frozen=True)
class _Bench:
    """A measurement. Its attributes are the arguments of :func:`measure`."""

    scene: Scene
    path: Path
    channels: Sequence[str]
    seconds: float
    processes: int | None
    report: Callable[[str], None]

    def at(self, rate: float) -> BenchResult:
        """Start the nodes, measure, and stop the nodes. ``rate``: requested frames per second."""
        topics = topics_of(self.scene, self.channels)
        counted = in_step(self.scene.scene_cameras)
        whole = [topic for topic in topics if topic.split("/")[1] in counted]
        started = self._nodes(rate)
        prepare_transport(len(started) + 1, network=False)
        with Supervisor(started) as nodes, _Subscriber(topics, whole) as subscriber:
            self.report(f"starting {len(started)} nodes, and drawing lens and static scene of each camera")
            subscriber.wait_for_all(nodes, _START_LIMIT)
            self.report(f"measuring for {self.seconds:g} s")
            subscriber.spin(_SETTLING)
            subscriber.reset()
            pids = {"subscriber": os.getpid(), **nodes.pids}
            begin, before = time.monotonic(), CpuTime.now(pids)
            subscriber.spin(self.seconds)
            if dead := nodes.dead():
                raise RosError(str(dead))
            used, elapsed = CpuTime.now(pids).since(before), time.monotonic() - begin
        frames = subscriber.complete * self.scene.scene_cameras[counted[0]].timing.step
        names = [process.node_name for process in started if process.renders]
        in_cameras = sum(used.processes[name] for name in names)
        pictures = sum(1 / camera.timing.step for camera in self.scene.scene_cameras.values())
        return BenchResult(
            cameras={name: subscriber.milliseconds(name) for name in self.scene.cameras},
            pictures=pictures,
            channels=tuple(self.channels),
            rate=self.scene.config.rate,
            measured_hz=frames / elapsed,
            frame_ms=1e3 * (used.total - in_cameras) / max(1, frames),
            camera_ms=1e3 * in_cameras / max(1, frames) / pictures,
            processes=len(names),
            cores=cores(),
            other_cores=max(0.0, (used.machine - used.total) / elapsed),
        )

    def _nodes(self, rate: float) -> list[NodeProcess]:
        """Processes of the scene. They log only errors. ``rate``: rate of the motion player."""
        nodes = scene_processes(self.path, self.processes, time=TimeOptions(lockstep=False))
        own = {"motion_player": {"rate": rate}}
        return [
            replace(node, parameters={**node.parameters, **own.get(node.executable, {})}, log_level="error")
            for node in nodes
        ]


class _Subscriber(Listener):
    """Subscribes to topics, and counts complete frames. A frame is complete if there is a message with its
    stamp on each topic of ``whole``."""

    def __init__(self, topics: Sequence[str], whole: Sequence[str]) -> None:
        super().__init__("humansim_bench")
        self._frames: Frames[None] = Frames(whole, max_frames=_MAX_INCOMPLETE)
        self._diagnostics: dict[str, list[float]] = defaultdict(list)
        self.complete = 0
        for topic in topics:
            self.listen(Image, topic, partial(self._on_image, topic))
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 50)

    def _on_image(self, topic: str, data: bytes) -> None:
        stamp = serialised_stamp(data)
        if self._frames.add(topic, stamp, None):
            self.complete += 1
            self._frames.pop(stamp)

    def reset(self) -> None:
        """Forget all messages."""
        self._frames.clear()
        self._diagnostics.clear()
        self.complete = 0

    def milliseconds(self, camera: str) -> float:
        """Median time that a camera needs to render and send a frame. 0 if the camera has not reported it."""
        times = self._diagnostics[f"/{camera}"]
        return median(times) if times else 0.0

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            milliseconds = float(values.get("render_median_ms", "nan"))
            if 0 <= milliseconds < math.inf:
                self._diagnostics[status.name].append(milliseconds)


@dataclass(frozen=True)
class CpuTime:
    """CPU time used by each process, and by the whole machine, seconds."""

    processes: dict[str, float]
    machine: float

    @classmethod
    def now(cls, pids: Mapping[str, int]) -> CpuTime:
        """CPU time until now. ``pids``: process ids by name."""
        tick = os.sysconf("SC_CLK_TCK")
        seconds = {}
        for name, pid in pids.items():
            fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
            seconds[name] = (int(fields[11]) + int(fields[12])) / tick
        machine = [int(n) for n in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
        used = sum(machine) - machine[3] - machine[4]  # without idle time and waiting for a disk
        return cls(seconds, used / tick)

    def since(self, before: CpuTime) -> CpuTime:
        """CPU time since an earlier time, of the same processes."""
        used = {name: seconds - before.processes[name] for name, seconds in self.processes.items()}
        return CpuTime(used, self.machine - before.machine)

    @property
    def total(self) -> float:
        """CPU seconds of all processes."""
        return sum(self.processes.values())


def in_step(cameras: Mapping[str, SceneCamera]) -> list[str]:
    """Names of the cameras that have the highest rate, and take their pictures in the same frames."""
    fastest = min((camera.timing for camera in cameras.values()), key=lambda timing: timing.step)
    return [name for name, camera in cameras.items() if camera.timing == fastest]
