"""Frames of a scene as chunks of a bag: the content of a recording, whoever writes it."""

from __future__ import annotations

import socket
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import TracebackType
from typing import Any

from sensor_msgs.msg import CompressedImage

from humansim_ros.bags.chunks import BagMessage, Chunk, encode_chunk
from humansim_ros.bags.topics import BagTopic, Qos, described
from humansim_ros.errors import RenderError
from humansim_ros.messages.cdr import serialised
from humansim_ros.messages.topics import Topic
from humansim_ros.record.plan import PLAN, RecordingPlan
from humansim_ros.scene import Scene, Simulation
from humansim_ros.scene.simulation import Frame

#: Steps of encoding a frame, for the summary of costs.
STARTING, RENDERING = "first frame of each process", "rendering"
TRUTH, IMAGE_COMPRESSION = "truth and messages", "image compression"
SERIALISING, CHUNKS = "serialising", "checksums and chunk compression"


@dataclass(frozen=True)
class SceneRecording:
    """A scene and the plan of its recording. It can be copied to another process, and to another machine.

    A frame is a group of chunks: one with the topics that belong to no camera, then one for each camera.
    """

    scene: Scene
    plan: RecordingPlan

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.scene, self.plan)  # the table has functions, which cannot be copied

    @cached_property
    def table(self) -> Sequence[Topic[Any]]:
        """Topics that are recorded; a chunk names them by their index."""
        return self.plan.recorded_topics(self.scene)

    @property
    def topics(self) -> Sequence[BagTopic]:
        """Topics of the bag."""
        return [described(_bag_topic(topic)) for topic in self.table]

    @property
    def custom(self) -> Mapping[str, str]:
        """Texts for ``custom_data`` of the bag."""
        return {PLAN: self.plan.to_json()}

    @property
    def frames(self) -> int:
        """Number of frames with messages: one if all topics have a single message for the scene."""
        return self.plan.frames if any(topic.per_frame for topic in self.table) else 1

    @property
    def cameras(self) -> Sequence[str]:
        """Names of the cameras of which topics are recorded."""
        return list(dict.fromkeys(topic.camera for topic in self.table if topic.camera))

    def start(self) -> FrameEncoder:
        """Encoder of all topics."""
        return FrameEncoder(self)

    def encoder(self, cameras: Collection[str], bodies: bool) -> FrameEncoder:
        """Encoder of some cameras, and of the topics that belong to no camera if ``bodies``.

        Raises:
            RenderError: This machine renders on another device than the plan says: pixels would differ.
        """
        encoder = FrameEncoder(self, cameras, bodies)
        if self.plan.device in encoder.device:
            return encoder
        encoder.close()
        raise RenderError(
            f"{socket.gethostname()} renders on {encoder.device}, and the recording is planned for "
            f"{self.plan.device}: pixels would differ. Use machines that are alike, also for the command"
        )


def _bag_topic(topic: Topic[Any]) -> BagTopic:
    qos = Qos(transient_local=topic.latched, depth=topic.depth)
    return BagTopic(f"/{topic.name}", topic.type_name, (qos,))


class FrameEncoder:
    """Renders frames of a recording and encodes them; use it in a ``with`` block.

    Args:
        recording: The recording.
        cameras: Names of the cameras of which topics are encoded; all if None.
        bodies: Whether topics that belong to no camera are encoded.

    Attributes:
        device: Name of the device that renders.
        costs: Seconds of processor time by step.
    """

    def __init__(
        self, recording: SceneRecording, cameras: Collection[str] | None = None, bodies: bool = True
    ) -> None:
        self._recording = recording
        chosen = [
            (index, topic)
            for index, topic in enumerate(recording.table)
            if (cameras is None or topic.camera in cameras if topic.camera else bodies)
        ]
        #: Topics with their index, by camera; those of no camera first.
        self._parts: dict[str, list[tuple[int, Topic[Any]]]] = {}
        for index, topic in chosen:
            self._parts.setdefault(topic.camera, []).append((index, topic))
        self._cameras = [name for name in self._parts if name]
        self._rectified = {topic.camera for _, topic in chosen if topic.rectified_depth}
        channels = frozenset[str]().union(*(topic.channels for _, topic in chosen))
        renderer = recording.scene.make_renderer()
        self.device = renderer.device
        self._simulation = Simulation(recording.scene, sorted(channels), renderer=renderer)
        self._started = False
        self.costs: dict[str, float] = {}

    def __enter__(self) -> FrameEncoder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the renderer."""
        self._simulation.close()

    def encode(self, index: int) -> list[Chunk]:
        """Chunks of a frame in the order of the bag, each time the same bytes.

        There is none if all topics have a single message for the scene, unless it is frame 0.

        Raises:
            HumansimError: The frame cannot be rendered.
        """
        start = time.process_time()
        frame = self._simulation.frame(index, self._cameras, self._rectified)
        self._add_cost(RENDERING, start)
        chunks = [self._chunk(frame, topics) for topics in self._parts.values()]
        if not self._started:
            # with the compilation of shaders and the messages for the scene
            self.costs, self._started = {STARTING: sum(self.costs.values())}, True
        return [chunk for chunk in chunks if chunk is not None]

    def _chunk(self, frame: Frame, topics: Sequence[tuple[int, Topic[Any]]]) -> Chunk | None:
        """Chunk of one camera, or of the topics of no camera; None without messages."""
        messages = []
        for index, topic in topics:
            if topic.per_frame or frame.index == 0:
                start = time.process_time()
                sent = topic.sent(frame)
                start = self._add_cost(IMAGE_COMPRESSION if topic.type is CompressedImage else TRUTH, start)
                messages += [
                    BagMessage(index, time_sent, serialised(message, topic.type_name))
                    for time_sent, message in sent
                ]
                self._add_cost(SERIALISING, start)
        if not messages:
            return None
        start = time.process_time()
        messages.sort(key=lambda message: message.stamp)  # faults send some of them later
        chunk = encode_chunk(messages, self._recording.plan.compression)
        self._add_cost(CHUNKS, start)
        return chunk

    def _add_cost(self, step: str, start: float) -> float:
        """Add the processor time since ``start`` to a step; return the time now."""
        now = time.process_time()
        self.costs[step] = self.costs.get(step, 0.0) + now - start
        return now
