"""Plan of a recording: everything that determines the content of its bag."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass, fields
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal, TypeAlias

from humansim_ros import __version__
from humansim_ros.bags.chunks import Compression
from humansim_ros.bags.metadata import Storage, read_metadata
from humansim_ros.errors import BagError, near_names
from humansim_ros.messages import ImageCompression
from humansim_ros.messages.topics import COMPRESSED, Topic, scene_topics
from humansim_ros.render.channels import CHANNEL_TABLE
from humansim_ros.render.context import OpenGLContext
from humansim_ros.scene import Scene
from humansim_ros.scene.scene import scene_hash

ImageFormat: TypeAlias = Literal["raw", "jpeg", "png"]
DepthFormat: TypeAlias = Literal["raw", "png"]

#: Name of the plan in ``custom_data`` of ``metadata.yaml``.
PLAN = "humansim_recording"
#: Ends of the topics that replace raw images.
_COMPRESSED = {
    f"/{CHANNEL_TABLE[name].topic}": f"/{CHANNEL_TABLE[name].topic}/{end}" for name, end in COMPRESSED.items()
}
#: Most topics that an error lists.
_MAX_LISTED = 6


@dataclass(frozen=True)
class RecordingPlan:
    """Everything that determines the content of a recording.

    Attributes:
        scene: Hash of the scene and of the files that it names.
        frames: Number of frames.
        topics: Absolute names of the topics.
        images: Format of ``image_raw`` and ``image_raw/compressed``.
        storage: ``mcap`` or ``sqlite3``.
        compression: Compression of the chunks.
        max_size: Size in bytes at which the bag is split; 0: never.
        max_duration: Seconds after which the bag is split; 0: never.
        device: Device that renders: others round differently.
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
        """Plan the recording of a scene on this machine; see :meth:`with_table`."""
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
        storage: Storage = "mcap",
        compression: Compression = "none",
        max_size: int = 0,
        max_duration: float = 0.0,
    ) -> tuple[RecordingPlan, list[Topic[Any]]]:
        """Plan the recording of a scene; return the plan, and the topics that are recorded.

        Args:
            scene: The scene.
            frames: Number of frames, at least 1.
            patterns: Names of topics, or patterns with ``*`` and ``?``; the default topics if empty.
            device: Device that renders.
            images: Format of colour images.
            depth: Format of depth.
            storage: Storage of the bag.
            compression: Compression of its chunks.
            max_size: Size in bytes at which the bag is split; 0: never.
            max_duration: Seconds after which the bag is split; 0: never.

        Raises:
            BagError: No topic has a name, or fits a pattern.
        """
        table = scene_topics(scene, _image_compression(images))
        chosen = _chosen(table, patterns, images, depth)
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
        """The plan as text, the same for the same plan."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def of_bag(cls, folder: Path) -> RecordingPlan:
        """Read the plan of a bag. Raises BagError if it has none, as a bag of other programs."""
        custom = read_metadata(folder).get("custom_data") or {}
        try:
            values = json.loads(custom[PLAN])
            return cls(**{**values, "topics": tuple(values["topics"])})
        except (KeyError, TypeError, ValueError):
            raise BagError(
                "this bag was not written by `humansim record`: it cannot be continued", path=folder
            ) from None

    def differences(self, bag: RecordingPlan) -> list[str]:
        """What differs from the plan of a bag, in words."""
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
        """Topics of the table of the scene that are recorded, in its order."""
        return _rows(scene_topics(scene, _image_compression(self.images)), self.topics)


def _image_compression(images: ImageFormat) -> ImageCompression:
    return ImageCompression() if images == "raw" else ImageCompression(images)


def _rows(table: Sequence[Topic[Any]], names: Collection[str]) -> list[Topic[Any]]:
    """Topics of a table with some absolute names."""
    chosen = set(names)
    return [topic for topic in table if f"/{topic.name}" in chosen]


def _chosen(
    table: Sequence[Topic[Any]], patterns: Sequence[str], images: ImageFormat, depth: DepthFormat
) -> list[str]:
    """Absolute names of the topics that are recorded, in the order of the table."""
    names = [f"/{topic.name}" for topic in table]
    if patterns:
        chosen = {name for pattern in patterns for name in _matching(pattern, names)}
    else:
        # what the demo shows, and what gives it meaning
        chosen = {f"/{topic.name}" for topic in table if topic.recorded}
    for end, form in (("/image_raw", images), ("/depth/image", depth)):
        if form != "raw":
            chosen = {
                name.removesuffix(end) + _COMPRESSED[end] if name.endswith(end) else name for name in chosen
            }
    # a message for each frame, also of a camera that loses images
    faulty = {topic.camera for topic in table if topic.faulty and f"/{topic.name}" in chosen}
    chosen |= {f"/{topic.name}" for topic in table if topic.explains and topic.camera in faulty}
    return [name for name in names if name in chosen]


def _matching(pattern: str, names: Collection[str]) -> list[str]:
    """Topics that fit a name or pattern; its first slash may be absent. Raises BagError without any."""
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
