"""Work for a cluster: shards that need no scene and no OpenGL, and a scene whose workers die."""

from __future__ import annotations

import errno
import os
import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from humansim_ros.data.bags.chunks import BagMessage, Chunk, encode_chunk
from humansim_ros.data.bags.topics import BagTopic
from humansim_ros.data.engine.frame_job import Costs, FrameResult
from humansim_ros.data.formats.source import FrameReader, SimulatedSource
from humansim_ros.data.recording import RecordingPlan, result_of
from humansim_ros.scene import Frame

CAMERAS = ("left", "right", "top")
TOPICS = [BagTopic("/joints", "std_msgs/msg/Header")]
TOPICS += [BagTopic(f"/{name}/image", "sensor_msgs/msg/Image") for name in CAMERAS]


def group(index: int) -> list[Chunk]:
    """A chunk of the bodies and one for each camera."""
    data = [bytes([0, 1, 0, 0, number, index]) * (50 + 7 * number) for number in range(len(TOPICS))]
    return [
        encode_chunk([BagMessage(number, 1 + index * 100, each)], "zstd") for number, each in enumerate(data)
    ]


@dataclass(frozen=True)
class Numbers:
    """Numbers as messages.

    Each frame leaves a file with the number of its process in ``folder``. Before a frame is encoded, files
    there make it fail: ``kill_<frame>`` kills the worker once, ``full_<frame>`` is a full disk once, and
    ``broken_<frame>`` an error for ever.
    """

    folder: Path
    seed: int = 1
    frames: int = 12
    cameras: Sequence[str] = CAMERAS
    costs: Costs = field(default_factory=Costs, compare=False)

    @property
    def plan(self) -> RecordingPlan:
        return RecordingPlan("", self.frames, (), "raw", "mcap", "none", 0, 0.0, "")

    @property
    def topics(self) -> Sequence[BagTopic]:
        return TOPICS

    @property
    def custom(self) -> Mapping[str, str]:
        return {"numbers": f"{self.seed} in {self.folder}"}

    def start(self) -> Numbers:
        with (self.folder / "workers").open("a") as file:
            print(os.getpid(), file=file)
        return self

    def close(self) -> None:
        pass

    def work(self, index: int) -> FrameResult:
        with (self.folder / f"pids_{index:02}").open("a") as file:
            print(os.getpid(), file=file)
        if (mark := self.folder / f"kill_{index}").exists():
            mark.unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        if (mark := self.folder / f"full_{index}").exists():
            mark.unlink()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if (self.folder / f"broken_{index}").exists():
            raise ZeroDivisionError("no such number")
        return result_of(group(index))


@dataclass(frozen=True)
class DyingSource(SimulatedSource):
    """A scene whose workers are killed once, before frame 4, if the file ``mark`` exists."""

    mark: Path = Path()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.simulated, self.formats, self.keypoints, self.title, self.mark)

    def open(self) -> FrameReader:
        return _DyingFrames(super().open(), self.mark)


@dataclass(frozen=True)
class _DyingFrames:
    frames: FrameReader
    mark: Path

    def frame(self, index: int) -> Frame:
        if index == 4 and self.mark.exists():
            self.mark.unlink()
            os.kill(os.getpid(), signal.SIGKILL)
        return self.frames.frame(index)

    def close(self) -> None:
        self.frames.close()
