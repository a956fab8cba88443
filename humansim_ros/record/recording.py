"""Record a scene into a bag, with any number of processes, and continue an interrupted recording."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from humansim_ros.bags.chunks import BagMessage, Chunk, encode_chunk
from humansim_ros.bags.topics import BagTopic, Qos, described
from humansim_ros.bags.writer import BagWriter
from humansim_ros.errors import BagError, RenderError
from humansim_ros.jobs.frame_job import Costs, FrameProgress, FrameResult
from humansim_ros.jobs.workers import run_frames
from humansim_ros.messages.cdr import serialised
from humansim_ros.messages.topics import Topic
from humansim_ros.messages.types import CompressedImage
from humansim_ros.record.plan import PLAN, RecordingPlan
from humansim_ros.render import GLRenderer, PyrenderRenderer, Renderer
from humansim_ros.render.context import OpenGLContext
from humansim_ros.scene import Scene, Simulation
from humansim_ros.scene.simulation import Frame

#: Steps of a recording, for the summary of costs.
STARTING, RENDERING = "first frame of each process", "rendering"
TRUTH, IMAGE_COMPRESSION = "truth and messages", "image compression"
SERIALISING, CHUNKS, WRITING = "serialising", "checksums and chunk compression", "writing"


@dataclass(frozen=True)
class SceneRecording:
    """A scene and the plan of its recording: a job, which can be copied to other processes and machines.

    A frame is a group of chunks: one with the topics that belong to no camera, then one for each camera.
    """

    scene: Scene
    plan: RecordingPlan

    @classmethod
    def of(
        cls, scene: Scene, frames: int, patterns: Sequence[str] = (), *, jobs: int = 1, **options: Any
    ) -> SceneRecording:
        """Plan the recording of a scene on this machine.

        Args:
            scene: The scene.
            frames: Number of frames, at least 1.
            patterns: Names of topics, or patterns with ``*`` and ``?``; the default topics if empty.
            jobs: Number of processes that will record. With 1, the renderer of this process is made here.
            options: See :meth:`RecordingPlan.of`.

        Raises:
            BagError: No topic has a name, or fits a pattern.
            RenderError: OpenGL is missing.
        """
        opened: Any = scene.make_renderer() if jobs == 1 else OpenGLContext()
        plan, table = RecordingPlan.with_table(scene, frames, patterns, device=opened.device, **options)
        recording = cls(scene, plan)
        recording.__dict__["table"] = table
        if jobs == 1:
            recording.__dict__["_renderer"] = opened
        else:
            opened.close()
        return recording

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

    def start(self) -> RecordingWorker:
        """Make the renderer, or take the one of :meth:`of`.

        Raises:
            RenderError: This machine renders on another device than the plan says: pixels would differ.
        """
        renderer: GLRenderer | PyrenderRenderer = (
            self.__dict__.pop("_renderer", None) or self.scene.make_renderer()
        )
        if self.plan.device in renderer.device:
            return RecordingWorker(self, renderer)
        renderer.close()
        raise RenderError(
            f"{socket.gethostname()} renders on {renderer.device}, and the recording is planned for "
            f"{self.plan.device}: pixels would differ. Use machines that are alike, also for the command"
        )


def _bag_topic(topic: Topic[Any]) -> BagTopic:
    qos = Qos(transient_local=topic.latched, depth=topic.depth)
    return BagTopic(f"/{topic.name}", topic.type_name, (qos,))


class RecordingWorker:
    """Renders frames of a recording and encodes them.

    ``renderer``: renderer of the scene, which :meth:`close` frees.

    Attributes:
        costs: Seconds of processor time by step.
    """

    def __init__(self, recording: SceneRecording, renderer: Renderer) -> None:
        self._compression = recording.plan.compression
        #: Topics with their index, by camera; those of no camera first.
        self._parts: dict[str, list[tuple[int, Topic[Any]]]] = {}
        for index, topic in enumerate(recording.table):
            self._parts.setdefault(topic.camera, []).append((index, topic))
        self._cameras = [name for name in self._parts if name]
        self._rectified = {topic.camera for topic in recording.table if topic.rectified_depth}
        channels = frozenset[str]().union(*(topic.channels for topic in recording.table))
        self._simulation = Simulation(recording.scene, sorted(channels), renderer=renderer)
        self._started = False
        self.costs = Costs()

    def close(self) -> None:
        """Free the renderer."""
        self._simulation.close()

    def work(self, index: int) -> FrameResult:
        """Encode a frame; :func:`chunks_of` gives its chunks in the order of the bag, always the same bytes.

        There is no chunk if all topics have a single message for the scene, unless it is frame 0.

        Raises:
            HumansimError: The frame cannot be rendered.
        """
        start = time.process_time()
        frame = self._simulation.frame(index, self._cameras, self._rectified)
        self.costs.add(RENDERING, start)
        chunks = [self._chunk(frame, topics) for topics in self._parts.values()]
        if not self._started:
            # with the compilation of shaders and the messages for the scene
            self.costs, self._started = Costs({STARTING: sum(self.costs.values())}), True
        return result_of([chunk for chunk in chunks if chunk is not None])

    def _chunk(self, frame: Frame, topics: Sequence[tuple[int, Topic[Any]]]) -> Chunk | None:
        """Chunk of one camera, or of the topics of no camera; None without messages."""
        messages = []
        for index, topic in topics:
            if topic.per_frame or frame.index == 0:
                start = time.process_time()
                sent = topic.sent(frame)
                start = self.costs.add(IMAGE_COMPRESSION if topic.type is CompressedImage else TRUTH, start)
                messages += [
                    BagMessage(index, time_sent, serialised(message, topic.type_name))
                    for time_sent, message in sent
                ]
                self.costs.add(SERIALISING, start)
        if not messages:
            return None
        start = time.process_time()
        messages.sort(key=lambda message: message.stamp)  # faults send some of them later
        chunk = encode_chunk(messages, self._compression)
        self.costs.add(CHUNKS, start)
        return chunk


def result_of(chunks: Sequence[Chunk]) -> FrameResult:
    """Chunks as the result of a worker."""
    return FrameResult([replace(chunk, buffers=()) for chunk in chunks], [chunk.buffers for chunk in chunks])


def chunks_of(result: FrameResult) -> list[Chunk]:
    """Chunks of :func:`result_of`."""
    pairs = zip(result.value, result.data, strict=True)
    return [replace(chunk, buffers=tuple(buffers)) for chunk, buffers in pairs]


def record(
    recording: SceneRecording,
    folder: Path,
    jobs: int = 1,
    resume: bool = False,
    on_progress: Callable[[FrameProgress], None] = lambda _: None,
) -> FrameProgress:
    """Record a scene. The bytes of the bag do not depend on ``jobs``.

    However the recording ends, the bag is readable and has whole frames.

    Args:
        recording: Scene and plan.
        folder: Folder of the bag, which must not exist unless ``resume``.
        jobs: Number of processes that render; with 1, this process does.
        resume: Continue the recording if it has begun; nothing happens if it is complete.
        on_progress: Called after each frame; its argument is also the result.

    Raises:
        BagError: The folder exists, or cannot be written or continued; the disk is full.
        WorkerDiedError: A worker process has died.
        HumansimError: A frame cannot be rendered.
    """
    plan, writer = recording.plan, None
    begun = folder.exists() or folder.is_symlink()
    if resume and begun:
        check_plan(plan, folder)
    elif begun:
        raise BagError("this path exists; choose another one, or continue with --resume", path=folder)
    with ExitStack() as stack:
        progress = FrameProgress.of(recording.frames)
        if begun:
            writer = BagWriter.resume(folder, max_size=plan.max_size, max_duration=plan.max_duration)
            stack.enter_context(writer)
            progress.first = progress.done = writer.groups
            if progress.done >= progress.frames:
                return progress

        def begin() -> None:
            nonlocal writer
            writer = writer or stack.enter_context(
                BagWriter(
                    folder,
                    recording.topics,
                    storage=plan.storage,
                    compression=plan.compression,
                    max_size=plan.max_size,
                    max_duration=plan.max_duration,
                    custom=recording.custom,
                )
            )

        def append(_: int, result: FrameResult) -> int:
            assert writer is not None
            start, chunks = time.process_time(), chunks_of(result)
            for number, chunk in enumerate(chunks, 1):
                writer.append(chunk, ends_group=number == len(chunks))
            progress.add_cost(WRITING, time.process_time() - start)
            return sum(chunk.size for chunk in chunks)

        frames = range(progress.first, progress.frames)
        run_frames(recording, frames, jobs, progress, append, begin=begin, on_progress=on_progress)
    return progress


def check_plan(plan: RecordingPlan, folder: Path) -> None:
    """Raise BagError unless a bag has a plan, and the same."""
    if not folder.is_dir():
        raise BagError("there is no bag to continue here", path=folder)
    if differences := plan.differences(RecordingPlan.of_bag(folder)):
        raise BagError(f"this bag is another recording: {'; '.join(differences)}", path=folder)
