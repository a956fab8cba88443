"""Record a scene into a bag, with any number of processes, and continue an interrupted recording."""

from __future__ import annotations

import json
import shutil
import socket
import time
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields, replace
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeAlias

from humansim_ros import __version__
from humansim_ros.data.bags.chunks import BagMessage, Buffer, Chunk, Compression, encode_chunk
from humansim_ros.data.bags.metadata import Storage, read_metadata
from humansim_ros.data.bags.reader import BagReader
from humansim_ros.data.bags.topics import BagTopic, Qos, described
from humansim_ros.data.bags.writer import BagWriter, check_unlocked
from humansim_ros.data.engine.frame_job import Costs, FrameProgress, FrameResult
from humansim_ros.data.engine.workers import run_frames
from humansim_ros.data.formats.source import scene_hash
from humansim_ros.data.messages.cdr import serialised
from humansim_ros.data.messages.images import ImageCompression
from humansim_ros.data.messages.topic import Topic
from humansim_ros.data.messages.topics import SCENE_TIME_TOPIC, scene_topics
from humansim_ros.data.messages.types import CompressedImage
from humansim_ros.errors import BagError, HumansimWarning, RenderError, near_names, warn_about
from humansim_ros.files.reading import parse_json, size_text
from humansim_ros.render.device import OpenGLContext
from humansim_ros.render.frame import GLRenderer, PyrenderRenderer
from humansim_ros.render.interface import Renderer
from humansim_ros.scene.core import Frame, Needs, Scene, Simulation

ImageFormat: TypeAlias = Literal["raw", "jpeg", "png"]
DepthFormat: TypeAlias = Literal["raw", "png"]
LabelFormat: TypeAlias = Literal["raw", "png"]

#: Key of the plan in ``custom_data`` of ``metadata.yaml``.
PLAN = "humansim_recording"
#: Most topics that an error lists.
_MAX_LISTED = 6
#: After this number of new frames, the size of the remaining frames is estimated.
_ESTIMATED_AFTER = 5
#: Shares of the free space: an estimated size above the first causes a warning, above the second an error.
#: (Frames differ in size.)
_MUCH, _TOO_MUCH = 0.9, 1.5


@dataclass(frozen=True)
class RecordingPlan:
    """Everything that determines the content of a recording. A recording is continued only with the same
    plan.

    Attributes:
        scene: Hash of the scene and of the files that it names.
        frames: Number of frames.
        topics: Absolute names of the topics.
        images: Format of ``image_raw`` and ``image_raw/compressed``.
        storage: ``mcap`` or ``sqlite3``.
        compression: Compression of the chunks.
        max_size: Size in bytes at which the bag is split. If 0, never.
        max_duration: Seconds after which the bag is split. If 0, never.
        device: Device that renders. Another device rounds differently.
        version: Version of this package.
    """

    scene: str
    frames: int
    topics: tuple[str, ...]
    images: ImageFormat
    storage: Storage
    compression: Compression
    max_size: int
    max_duration: float
    device: str
    version: str = __version__

    @classmethod
    def of(cls, scene: Scene, frames: int, patterns: Sequence[str] = (), **options: Any) -> RecordingPlan:
        """Plan the recording of a scene on this machine. See :meth:`with_table`."""
        context = OpenGLContext()
        context.close()
        return cls.with_table(scene, frames, patterns, device=context.device, **options)[0]

    @classmethod
    def with_table(
        cls,
        scene: Scene,
        frames: int,
        patterns: Sequence[str] = (),
        *,
        device: str,
        images: ImageFormat = "raw",
        depth: DepthFormat = "raw",
        labels: LabelFormat = "raw",
        storage: Storage = "mcap",
        compression: Compression = "none",
        max_size: int = 0,
        max_duration: float = 0.0,
    ) -> tuple[RecordingPlan, list[Topic[Any]]]:
        """Plan the recording of a scene. Returns the plan, and the topics that are recorded.

        Args:
            scene: The scene.
            frames: Number of frames, at least 1.
            patterns: Names of topics, or patterns with ``*`` and ``?``. If empty, the default topics.
            device: Device that renders.
            images: Format of colour images.
            depth: Format of depth.
            labels: Format of the channels of integers of 8 and 16 bits, such as instance and part.
            storage: Storage of the bag.
            compression: Compression of its chunks.
            max_size: Size in bytes at which the bag is split. If 0, never.
            max_duration: Seconds after which the bag is split. If 0, never.

        Raises:
            BagError: A name or pattern fits no topic.
        """
        table = scene_topics(scene, _image_compression(images), png_labels=labels == "png")
        timed = {name for name, camera in scene.scene_cameras.items() if not camera.timing.is_full}
        chosen = _chosen(table, patterns, images, depth, labels, timed)
        plan = cls(
            scene=scene_hash(scene),
            frames=frames,
            topics=tuple(chosen),
            images=images,
            storage=storage,
            compression=compression,
            max_size=max_size,
            max_duration=float(max_duration),
            device=device,
        )
        return plan, _rows(table, chosen)

    def to_json(self) -> str:
        """Convert the plan to JSON. Equal plans have equal texts."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def of_bag(cls, folder: Path) -> RecordingPlan:
        """Read the plan of a bag. Raises BagError if the bag has no plan, for example a bag of another
        program."""
        custom = read_metadata(folder).get("custom_data") or {}
        try:
            values = parse_json(custom[PLAN], BagError)
            return cls(**{**values, "topics": tuple(values["topics"])})
        except (KeyError, TypeError, ValueError, BagError):
            raise BagError(
                "this bag was not written by `humansim record`: it cannot be continued", path=folder
            ) from None

    def differences(self, bag: RecordingPlan) -> list[str]:
        """Describe in words how this plan differs from the plan of a bag. Empty if they are equal."""
        texts = []
        for field in fields(self):
            here, there = getattr(self, field.name), getattr(bag, field.name)
            if here == there:
                continue
            if field.name == "scene":
                texts.append("the scene or a file of it has changed")
            elif field.name == "topics":
                texts.append(f"topics: {_listed_difference(there, here)}")
            else:
                texts.append(f"{field.name.replace('_', ' ')}: {there} in the bag, {here} now")
        return texts

    def recorded_topics(self, scene: Scene) -> list[Topic[Any]]:
        """Topics of the scene that are recorded, in the order of :func:`scene_topics`."""
        return _rows(scene_topics(scene, _image_compression(self.images), png_labels=True), self.topics)


def _image_compression(images: ImageFormat) -> ImageCompression:
    return ImageCompression() if images == "raw" else ImageCompression(images)


def _rows(table: Sequence[Topic[Any]], names: Collection[str]) -> list[Topic[Any]]:
    """Topics in ``table`` with the absolute names ``names``."""
    chosen = set(names)
    return [topic for topic in table if f"/{topic.name}" in chosen]


def _chosen(
    table: Sequence[Topic[Any]],
    patterns: Sequence[str],
    images: ImageFormat,
    depth: DepthFormat,
    labels: LabelFormat,
    timed: Collection[str],
) -> list[str]:
    """Absolute names of the topics that are recorded, in the order of the table.

    ``timed``: cameras that take no picture in some frames.
    """
    names = [f"/{topic.name}" for topic in table]
    if patterns:
        chosen = {name for pattern in patterns for name in _matching(pattern, names)}
    else:
        # what the demo shows, and the topics that explain it
        chosen = {f"/{topic.name}" for topic in table if topic.recorded}
    formats = {"rgb": images, "depth": depth}
    replaced = {
        f"/{topic.raw}": f"/{topic.name}"
        for topic in table
        if topic.raw and any(formats.get(channel, labels) != "raw" for channel in topic.channels)
    }
    chosen = {replaced.get(name, name) for name in chosen}
    # these have a message in each frame, even if a camera loses images or does not capture the frame, nobody
    # is seen, or no sweep ends
    faulty = {topic.camera for topic in table if topic.faulty and f"/{topic.name}" in chosen}
    of_frames = [topic for topic in table if topic.per_frame and f"/{topic.name}" in chosen]
    rare = of_frames and all(topic.sparse or topic.scanner for topic in of_frames)
    if rare or set(timed) & {topic.camera for topic in of_frames}:
        faulty.add(SCENE_TIME_TOPIC.camera)
    chosen |= {f"/{topic.name}" for topic in table if topic.explains and topic.camera in faulty}
    return [name for name in names if name in chosen]


def _matching(pattern: str, names: Collection[str]) -> list[str]:
    """Names that match a name or pattern. The first slash may be missing. Raises BagError if no topic
    fits."""
    absolute = pattern if pattern.startswith("/") else f"/{pattern}"
    found = [name for name in names if fnmatchcase(name, absolute)]
    if found:
        return found
    near = near_names(absolute, names, 0.5) or list(names)
    listed = ", ".join(near[:_MAX_LISTED])
    what = "no topic fits" if set("*?[") & set(pattern) else "there is no topic"
    raise BagError(f"{what} {pattern!r}; near it are {listed}", key="--topics")


def _listed_difference(bag: Collection[str], now: Collection[str]) -> str:
    only_bag = [name for name in bag if name not in now]
    only_now = [name for name in now if name not in bag]
    parts = [
        f"{', '.join(names[:_MAX_LISTED])}{', …' * (len(names) > _MAX_LISTED)} {where}"
        for names, where in ((only_bag, "only in the bag"), (only_now, "only now"))
        if names
    ]
    return "; ".join(parts) or "in another order"


#: Names of the steps of a recording in the summary of costs.
STARTING, RENDERING = "first frame of each process", "rendering"
TRUTH, IMAGE_COMPRESSION = "truth and messages", "image compression"
SERIALISING, CHUNKS, WRITING = "serialising", "checksums and chunk compression", "writing"


@dataclass(frozen=True)
class SceneRecording:
    """Job that records a scene according to a plan. It can be copied to other processes and machines. A frame
    becomes a group of chunks: one with the topics of no camera, then one for each camera."""

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
            patterns: Names of topics, or patterns with ``*`` and ``?``. If empty, the default topics.
            jobs: Number of processes that will record. If 1, the renderer of this process is created here.
            options: See :meth:`RecordingPlan.of`.

        Raises:
            BagError: A name or pattern fits no topic.
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
        """Topics that are recorded. Messages in chunks refer to a topic by its index here."""
        return self.plan.recorded_topics(self.scene)

    @property
    def topics(self) -> Sequence[BagTopic]:
        """The recorded topics as topics of a bag."""
        return [described(_bag_topic(topic)) for topic in self.table]

    @property
    def custom(self) -> Mapping[str, str]:
        """Texts for ``custom_data`` of the bag."""
        return {PLAN: self.plan.to_json()}

    @property
    def frames(self) -> int:
        """Number of frames that have messages; 1 if no topic has a message per frame, only one for the whole
        scene."""
        return self.plan.frames if any(topic.per_frame for topic in self.table) else 1

    @property
    def cameras(self) -> Sequence[str]:
        """Names of the cameras that have recorded topics."""
        return list(dict.fromkeys(topic.camera for topic in self.table if topic.camera))

    def start(self) -> RecordingWorker:
        """Start a worker with a new renderer, or with the renderer of :meth:`of`.

        Raises:
            RenderError: This machine renders on another device than that of the plan, so that pixels would
                differ.
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

    ``renderer``: renderer of the scene. :meth:`close` frees it.

    Attributes:
        costs: Seconds of processor time by step.
    """

    def __init__(self, recording: SceneRecording, renderer: Renderer) -> None:
        self._compression = recording.plan.compression
        #: By camera: topics with their indices. Topics of no camera come first.
        self._parts: dict[str, list[tuple[int, Topic[Any]]]] = {}
        #: Latched topics that may have a new message in each frame.
        self._latched: list[tuple[int, Topic[Any]]] = []
        for index, topic in enumerate(recording.table):
            changes = topic.latched and topic.per_frame
            part = self._latched if changes else self._parts.setdefault(topic.camera, [])
            part.append((index, topic))
        self._needs = Needs.of(recording.table)
        self._simulation = Simulation(recording.scene, renderer=renderer)
        self._started = False
        self.costs = Costs()

    def close(self) -> None:
        """Free the renderer."""
        self._simulation.close()

    def work(self, index: int) -> FrameResult:
        """Render and encode a frame. The result has its chunks in the order of the bag. Equal frames have
        equal bytes.

        If all topics have a single message for the whole scene, only frame 0 has a chunk.

        Raises:
            HumansimError: The frame cannot be rendered.
        """
        start = time.process_time()
        frame = self._simulation.frame(index, self._needs)
        self.costs.add(RENDERING, start)
        chunks = [self._chunk(frame, topics) for topics in self._parts.values()]
        latched = self._messages(frame, self._latched)
        if not self._started:
            # this includes the compilation of shaders and the messages for the scene
            self.costs, self._started = Costs({STARTING: sum(self.costs.values())}), True
        return result_of([chunk for chunk in chunks if chunk is not None], latched)

    def _messages(self, frame: Frame, topics: Sequence[tuple[int, Topic[Any]]]) -> list[BagMessage]:
        messages = list[BagMessage]()
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
        return messages

    def _chunk(self, frame: Frame, topics: Sequence[tuple[int, Topic[Any]]]) -> Chunk | None:
        """Encode the chunk of one camera, or of the topics of no camera; None if there are no messages."""
        messages = self._messages(frame, topics)
        if not messages:
            return None
        start = time.process_time()
        messages.sort(key=lambda message: message.stamp)  # faults send some messages later
        chunk = encode_chunk(messages, self._compression)
        self.costs.add(CHUNKS, start)
        return chunk


def result_of(chunks: Sequence[Chunk], latched: Sequence[BagMessage] = ()) -> FrameResult:
    """Pack the result of a worker: chunks, and latched messages, which may repeat earlier messages."""
    held = [message._replace(data=bytes(message.data)) for message in latched]
    bare = [replace(chunk, buffers=()) for chunk in chunks]
    return FrameResult((bare, held), [chunk.buffers for chunk in chunks])


class FrameChunks:
    """Unpacks the chunks of frames, one frame after the other. Messages of latched topics that repeat the
    previous message are left out. ``compression``: compression of the chunks with messages of latched
    topics."""

    def __init__(self, compression: Compression) -> None:
        self._compression = compression
        #: Newest message of each latched topic.
        self._newest: dict[int, Buffer] = {}

    def follow(self, bag: Path) -> None:
        """Read the newest latched messages from a bag that is continued."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", HumansimWarning)  # warns that the bag is not finished
            with BagReader(bag) as reader:
                latched = [topic.name for topic in reader.topics if any(q.transient_local for q in topic.qos)]
                self._newest = {each.topic: bytes(each.data) for each in reader.messages(latched)}

    def of(self, result: FrameResult) -> list[Chunk]:
        """Return the chunks of the next frame from its result, made by :func:`result_of`."""
        bare, latched = result.value
        changed = [message for message in latched if message.data != self._newest.get(message.topic)]
        self._newest |= {message.topic: message.data for message in changed}
        chunks = [encode_chunk(changed, self._compression)] if changed else []
        pairs = zip(bare, result.data, strict=True)
        return [*chunks, *(replace(chunk, buffers=tuple(buffers)) for chunk, buffers in pairs)]


def record(
    recording: SceneRecording,
    folder: Path,
    jobs: int = 1,
    resume: bool = False,
    on_progress: Callable[[FrameProgress], None] = lambda _: None,
) -> FrameProgress:
    """Record a scene. The bytes of the bag do not depend on ``jobs``.

    However the recording ends, the bag is readable and has only complete frames.

    Args:
        recording: Scene and plan.
        folder: Folder of the bag. It must not exist, unless ``resume`` is set.
        jobs: Number of processes that render. If 1, this process renders.
        resume: Whether an interrupted recording is continued. If it is complete, nothing happens.
        on_progress: Called after each frame with the progress, which is also the result.

    Raises:
        BagError: The folder exists, or cannot be written or continued; or the disk is full.
        WorkerDiedError: A worker process has died.
        HumansimError: A frame cannot be rendered.
    """
    plan, writer = recording.plan, None
    begun = folder.exists() or folder.is_symlink()
    if resume and begun:
        if folder.is_dir():
            check_unlocked(folder)  # a bag that has just begun has no plan yet
        check_plan(plan, folder)
    elif begun:
        raise BagError("this path exists; choose another one, or continue with --resume", path=folder)
    with ExitStack() as stack:
        progress = FrameProgress.of(recording.frames)
        frame_chunks = FrameChunks(plan.compression)
        if begun:
            writer = BagWriter.resume(folder, max_size=plan.max_size, max_duration=plan.max_duration)
            stack.enter_context(writer)
            progress.first = progress.done = writer.groups
            if progress.done >= progress.frames:
                return progress
            if writer.groups:
                frame_chunks.follow(folder)

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
            start, chunks = time.process_time(), frame_chunks.of(result)
            for number, chunk in enumerate(chunks, 1):
                writer.append(chunk, ends_group=number == len(chunks))
            progress.add_cost(WRITING, time.process_time() - start)
            size = sum(chunk.size for chunk in chunks)
            if progress.new + 1 == _ESTIMATED_AFTER:
                check_space(
                    folder, (progress.size + size) / _ESTIMATED_AFTER, progress.frames - progress.done - 1
                )
            return size

        frames = range(progress.first, progress.frames)
        run_frames(recording, frames, jobs, progress, append, begin=begin, on_progress=on_progress)
    return progress


def check_space(folder: Path, frame_size: float, frames: int) -> None:
    """Warn if the remaining frames may not fit on the disk of a bag.

    Args:
        folder: Folder of the bag.
        frame_size: Size of a frame, bytes.
        frames: Number of remaining frames.

    Raises:
        BagError: The frames need more than 1.5 times the free space.
    """
    needed, free = int(frame_size * frames), shutil.disk_usage(folder).free
    text = (
        f"the other {frames} frames need about {size_text(needed)}, but {size_text(free)} are free on the "
        "disk; --images jpeg and --depth png need less, --topics chooses what is recorded"
    )
    if needed > _TOO_MUCH * free:
        raise BagError(f"{text}. With more space, the same command with --resume goes on", path=folder)
    if needed > _MUCH * free:
        warn_about(folder, text)


def check_plan(plan: RecordingPlan, folder: Path) -> None:
    """Check that a bag has the same plan. Raises BagError, which names the differences."""
    if not folder.is_dir():
        raise BagError("there is no bag to continue here", path=folder)
    bag = RecordingPlan.of_bag(folder)
    if differences := plan.differences(bag):
        # such as a bag of an older version without /tf
        same = bag.topics != plan.topics and not replace(plan, topics=bag.topics).differences(bag)
        remedy = ". To continue it, give just its topics with --topics" if same else ""
        raise BagError(f"this bag is another recording: {'; '.join(differences)}{remedy}", path=folder)
