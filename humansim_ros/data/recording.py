"""Plan of a recording of a scene: which topics, in which form; and the worker that writes its bag, shard by
shard."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeAlias

from humansim_ros.data.bags.metadata import NAME as METADATA
from humansim_ros.data.bags.metadata import Content, Storage, metadata_text, parse_metadata
from humansim_ros.data.bags.topics import BagMessage, BagTopic, Qos, described
from humansim_ros.data.bags.writer import SQLITE_DEPRECATED, Compression, McapFile
from humansim_ros.data.engine import (
    TEMPORARY,
    WORK,
    Costs,
    Done,
    OutputFolder,
    WorkPlan,
    WorkShard,
    Written,
    shards_of,
)
from humansim_ros.data.formats.source import scene_hash
from humansim_ros.data.messages.cdr import serialised
from humansim_ros.data.messages.images import ImageCompression
from humansim_ros.data.messages.topic import Topic
from humansim_ros.data.messages.topics import SCENE_TIME_TOPIC, scene_topics
from humansim_ros.data.messages.types import CompressedImage
from humansim_ros.errors import BagError, near_names, warn_about
from humansim_ros.files.reading import package_version, parse_json
from humansim_ros.render.device import rendering_device
from humansim_ros.scene.core import Frame, Needs, Scene, Simulation

ImageFormat: TypeAlias = Literal["raw", "jpeg", "png"]
DepthFormat: TypeAlias = Literal["raw", "png"]
LabelFormat: TypeAlias = Literal["raw", "png"]

#: Key of the plan in ``custom_data`` of ``metadata.yaml``.
PLAN = "humansim_recording"
#: Smallest size at which a file is split, bytes.
_LEAST_SIZE = 1024
#: Most topics that an error lists.
_MAX_LISTED = 6
#: Names of the steps of a recording in the summary of costs.
STARTING, RENDERING = "first frame of each process", "rendering"
TRUTH, IMAGE_COMPRESSION = "truth and messages", "image compression"
SERIALISING, WRITING = "serialising", "writing"


@dataclass(frozen=True)
class SceneRecording(WorkPlan):
    """Plan of a recording: everything that determines the content of a bag. It can be copied to other
    processes and machines.

    Attributes:
        scene: The scene.
        length: Number of frames.
        topics: Absolute names of the topics.
        images: Format of ``image_raw`` and ``image_raw/compressed``.
        storage: ``mcap`` or ``sqlite3``.
        compression: Compression of the chunks.
        max_size: Size in bytes at which a file of the bag is split. If 0, never.
        shard_frames: Number of frames of a file. If None, it follows from the number of frames.
        device: Device that renders. Another device rounds differently.
        name: Name of the bag, which is the beginning of the names of its files.
    """

    scene: Scene
    length: int
    topics: tuple[str, ...]
    images: ImageFormat
    storage: Storage
    compression: Compression
    max_size: int
    shard_frames: int | None
    device: str
    name: str = "bag"
    what = "recording"
    saving = "; --images jpeg and --depth png need less, --topics chooses what is recorded"
    error = BagError

    @classmethod
    def of(
        cls,
        scene: Scene,
        frames: int,
        patterns: Sequence[str] = (),
        *,
        images: ImageFormat = "raw",
        depth: DepthFormat = "raw",
        labels: LabelFormat = "raw",
        storage: Storage = "mcap",
        compression: Compression = "none",
        max_size: int | None = None,
        max_duration: float = 0.0,
        shard_frames: int | None = None,
        name: str = "bag",
    ) -> SceneRecording:
        """Plan the recording of a scene on this machine.

        Args:
            scene: The scene.
            frames: Number of frames, at least 1.
            patterns: Names of topics, or patterns with ``*`` and ``?``. If empty, the default topics.
            images: Format of colour images.
            depth: Format of depth.
            labels: Format of the channels of integers of 8 and 16 bits, such as instance and part.
            storage: Storage of the bag.
            compression: Compression of its chunks.
            max_size: Size in bytes at which a file is split. If 0, the bag has one file. If None, each shard
                is a file.
            max_duration: Seconds of a file. If 0, the number of frames decides.
            shard_frames: Number of frames of a file. If None, it follows from the other arguments.
            name: Name of the bag.

        Raises:
            BagError: A name or pattern fits no topic.
            RenderError: OpenGL is missing.
        """
        table = scene_topics(scene, _image_compression(images), png_labels=labels == "png")
        timed = {name for name, camera in scene.scene_cameras.items() if not camera.timing.is_full}
        chosen = _chosen(table, patterns, images, depth, labels, timed)
        if storage == "sqlite3":
            warn_about("storage sqlite3", SQLITE_DEPRECATED)
        if storage == "sqlite3" and compression != "none":
            raise BagError("files of sqlite3 are not compressed; choose the storage mcap", key="--storage")
        if max_size and max_size < _LEAST_SIZE:
            raise BagError(f"must be 0 (one file) or at least {_LEAST_SIZE} bytes", key="--max-bag-size")
        if max_duration:
            shard_frames = max(1, int(max_duration * scene.config.rate))
        elif max_size == 0 or storage == "sqlite3":
            shard_frames = frames
        recording = cls(
            scene=scene,
            length=frames,
            topics=tuple(chosen),
            images=images,
            storage=storage,
            compression=compression,
            max_size=max_size or 0,
            shard_frames=shard_frames,
            device=rendering_device(),
            name=name,
        )
        recording.__dict__["table"] = _rows(table, chosen)
        return recording

    def __reduce__(self) -> tuple[Any, ...]:
        # the table has functions, which cannot be copied
        return type(self), (
            *(self.scene, self.length, self.topics, self.images, self.storage, self.compression),
            *(self.max_size, self.shard_frames, self.device, self.name),
        )

    @cached_property
    def key(self) -> Mapping[str, Any]:
        """JSON values that are equal for recordings with the same content."""
        return {
            "scene": scene_hash(self.scene),
            "frames": self.length,
            "topics": list(self.topics),
            "images": self.images,
            "storage": self.storage,
            "compression": self.compression,
            "max_size": self.max_size,
            "shard_frames": len(self.shards[0].items),
            "device": self.device,
            "version": package_version(),
        }

    @cached_property
    def shards(self) -> Sequence[WorkShard]:
        """The files of the bag, each with its frames.

        If no topic has a message per frame, only messages for the whole scene, there is frame 0 alone.
        """
        count = self.length if any(topic.per_frame for topic in self.table) else 1
        return shards_of(range(count), self.shard_frames)

    @cached_property
    def table(self) -> Sequence[Topic[Any]]:
        """Topics that are recorded, in the order of :func:`scene_topics`. Messages in a file refer to a topic
        by its index here."""
        table = scene_topics(self.scene, _image_compression(self.images), png_labels=True)
        return _rows(table, self.topics)

    @property
    def views(self) -> int:
        """Number of camera-frames for each frame."""
        return len({topic.camera for topic in self.table if topic.camera and topic.per_frame})

    @cached_property
    def bag_topics(self) -> Sequence[BagTopic]:
        """The recorded topics as topics of a bag."""
        return [described(_bag_topic(topic)) for topic in self.table]

    def open(self) -> RecordingWorker:
        """Start a worker with a new renderer. Raises RenderError if OpenGL is missing."""
        return RecordingWorker(self)

    def finished(self, folder: OutputFolder) -> tuple[Mapping[str, Any], Collection[int]] | None:
        """Key and shards of a finished bag. Raises BagError for a bag of another program or version."""
        if folder.size(METADATA) is None:
            return None
        custom = parse_metadata(folder.read(METADATA), folder.url).get("custom_data") or {}
        try:
            key = parse_json(custom[PLAN], BagError)
            key["shard_frames"]
        except (KeyError, TypeError, ValueError, BagError):
            raise BagError(
                "this bag was not written by `humansim record` of this version: it cannot be continued",
                path=folder.url,
            ) from None
        return key, [shard.number for shard in self.shards]

    def finish(self, done: Collection[Done], folder: OutputFolder) -> None:
        """Write ``metadata.yaml``. With storage ``sqlite3``, convert the bag first."""
        files = [
            (name, Content(dict(counts), start, end))
            for each in done
            for name, counts, start, end in each.rows
        ]
        custom = {PLAN: json.dumps(self.key, sort_keys=True)}
        if self.storage == "sqlite3":
            files = [self._converted(folder, files)]
        text = metadata_text(self.storage, self.bag_topics, files, custom)
        folder.write(METADATA, text)

    def _converted(self, folder: OutputFolder, files: Sequence[tuple[str, Content]]) -> tuple[str, Content]:
        """Convert MCAP files to one file of sqlite3. Returns its name and content."""
        from humansim_ros.data.bags.sqlite_file import write_sqlite

        place, name, whole = folder.path(f"{WORK}/converted"), f"{self.name}_0.db3", Content()
        folder.delete(f"{WORK}/converted")  # from a kill here
        write_sqlite([folder.path(each) for each, _ in files], place)
        for _, content in files:
            whole.add(content.counts, content.start, content.end)
        folder.put(place / "converted.db3", name)
        return name, whole


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


def _bag_topic(topic: Topic[Any]) -> BagTopic:
    qos = Qos(transient_local=topic.latched, depth=topic.depth)
    return BagTopic(f"/{topic.name}", topic.type_name, (qos,))


class RecordingWorker:
    """Renders the frames of a recording, and writes the files of its shards.

    Attributes:
        device: Device that renders.
        costs: Seconds of processor time by step.
    """

    def __init__(self, recording: SceneRecording) -> None:
        self._recording = recording
        #: By camera: topics with their indices. Topics of no camera come first.
        self._parts: dict[str, list[tuple[int, Topic[Any]]]] = {}
        #: Latched topics that may have a new message in each frame.
        self._latched: list[tuple[int, Topic[Any]]] = []
        for index, topic in enumerate(recording.table):
            changes = topic.latched and topic.per_frame
            part = self._latched if changes else self._parts.setdefault(topic.camera, [])
            part.append((index, topic))
        self._needs = Needs.of(recording.table)
        self._simulation = Simulation(recording.scene)
        self.device = self._simulation.renderer.device
        self._started = False
        self.costs = Costs()

    def close(self) -> None:
        """Free the renderer."""
        self._simulation.close()

    def write(self, shard: WorkShard, folder: Path, tick: Callable[[], None]) -> Written:
        """Write the frames of a shard to one file, or to several of the maximum size.

        Returns:
            Rows with name, numbers of messages by topic, first and last stamp of each file.

        Raises:
            HumansimError: A frame cannot be rendered, or a file cannot be written.
        """
        recording, rows = self._recording, list[Any]()
        newest = dict[int, bytes]()
        file = self._file(folder, name := self._name(shard, 0))
        with ExitStack() as stack:
            stack.callback(lambda: file.abandon())
            for index in shard.items:
                messages = self._frame(index, newest)
                start = time.process_time()
                for each in messages:
                    file.write(each)
                if recording.max_size and file.size >= recording.max_size and index != shard.items[-1]:
                    rows.append(_row(name, file.close()))
                    file = self._file(folder, name := self._name(shard, len(rows)))
                self.costs.add(WRITING, start)
                tick()
            rows.append(_row(name, file.close()))
        return Written(rows)

    def _name(self, shard: WorkShard, part: int) -> str:
        number = f"{shard.number}_{part}" if part else f"{shard.number}"
        place = f"{TEMPORARY}/" if self._recording.storage == "sqlite3" else ""  # it is converted at the end
        return f"{place}{self._recording.name}_{number}.mcap"

    def _file(self, folder: Path, name: str) -> McapFile:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        return McapFile(folder / name, self._recording.bag_topics, self._recording.compression)

    def _frame(self, index: int, newest: dict[int, bytes]) -> list[list[BagMessage]]:
        """Messages of a frame: latched ones that have changed, those of no camera, and those of each camera.

        ``newest``: newest message of each latched topic in this file. This function updates it.
        """
        start = time.process_time()
        frame = self._simulation.frame(index, self._needs)
        self.costs.add(RENDERING, start)
        parts = [self._messages(frame, topics) for topics in self._parts.values()]
        latched = self._messages(frame, self._latched)
        changed = [message for message in latched if message.data != newest.get(message.topic)]
        newest |= {message.topic: bytes(message.data) for message in changed}
        if not self._started:
            # this includes the compilation of shaders and the messages for the scene
            total = sum(self.costs.values())
            self.costs.clear()
            self.costs[STARTING], self._started = total, True
        return [messages for messages in (changed, *parts) if messages]

    def _messages(self, frame: Frame, topics: Sequence[tuple[int, Topic[Any]]]) -> list[BagMessage]:
        """Messages of some topics, in the order of their stamps."""
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
        return sorted(messages, key=lambda message: message.stamp)  # faults send some messages later


def _row(name: str, content: Content) -> list[Any]:
    return [name, sorted(content.counts.items()), content.start, content.end]
