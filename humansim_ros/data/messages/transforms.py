"""Transforms of tf: topics ``/tf`` and ``/tf_static`` of a scene, and poses of coordinate frames by time."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from humansim_ros.data.messages.cameras import transform_message
from humansim_ros.data.messages.cdr import unpack
from humansim_ros.data.messages.headers import TF_STATIC_TOPIC, TF_TOPIC, WORLD_FRAME
from humansim_ros.data.messages.topic import Topic
from humansim_ros.data.messages.types import TransformStamped
from humansim_ros.errors import RosError, within_bounds
from humansim_ros.geometry import ObjectPose, quaternion_to_matrix, transform
from humansim_ros.scene.core import Frame, Scene
from humansim_ros.types import Array

#: Type of the messages of tf.
TF = "tf2_msgs/msg/TFMessage"
#: Limits: length of a message, bytes; number of frames; transforms of a frame in a running program.
_MAX_BYTES, _MAX_FRAMES, _MAX_KEPT = 1 << 20, 2000, 20_000
_MAX_NAME = 256
#: Format of translation and quaternion xyzw in a serialised transform, and their size in bytes.
_NUMBERS, _NUMBERS_SIZE = "7d", 56


def fixed_transform(pose: ObjectPose, parent: str, child: str) -> Topic[ObjectPose]:
    """Create a transform that never changes. It becomes part of ``/tf_static``.

    Args:
        pose: Pose of the child frame in the parent frame.
        parent: Name of the parent frame.
        child: Name of the child frame.
    """
    return Topic(
        TF_STATIC_TOPIC,
        TransformStamped,
        lambda pose, stamp: transform_message(pose.position, pose.rotation, stamp, parent, child),
        lambda _: pose,
        per_frame=False,
    )


@dataclass(frozen=True)
class TransformTopic(Topic[Frame]):
    """Topic ``/tf`` or ``/tf_static``. A message has the transforms of all nodes; without transforms there is
    no message."""

    @property
    def recorded(self) -> bool:
        """Whether a recording includes the topic by default."""
        return True

    def sent(self, frame: Frame) -> list[tuple[int, Any]]:
        """Messages of a simulated frame, each with the time in nanoseconds when it is sent."""
        message = self.message(frame)
        return [(frame.stamp, message)] if message.transforms else []


def transform_topics(scene: Scene, parts: Sequence[Topic[Any]]) -> Iterator[TransformTopic]:
    """Create topics ``/tf_static`` and ``/tf`` of a scene. A topic without transforms is left out.

    A camera with its own rate has a transform only in the frames that it captures.

    Args:
        scene: The scene.
        parts: Topics of all transforms. Their messages are TransformStamped or lists of TFMessage. Topics
            with a message per frame become part of ``/tf``.
    """
    from humansim_ros.data.messages.types import TFMessage

    def message_of(own: Sequence[Topic[Any]]) -> Callable[[Frame, int], Any]:
        def build(frame: Frame, stamp: int) -> Any:
            transforms: list[TransformStamped] = []
            for part in own:
                camera = scene.scene_cameras.get(part.camera)
                if part.per_frame and camera is not None and frame.index not in camera.timing:
                    continue
                built = part.build(part.content(frame), stamp)
                if part.type is TFMessage:
                    transforms += [each for message in built for each in message.transforms]
                else:
                    transforms.append(built)
            return TFMessage(transforms=transforms)

        return build

    for name, moves in ((TF_STATIC_TOPIC, False), (TF_TOPIC, True)):
        if own := [part for part in parts if part.per_frame == moves]:
            yield TransformTopic(
                name,
                TFMessage,
                message_of(own),
                lambda frame: frame,
                latched=not moves,
                per_frame=moves,
                # transforms of people are made from the truth of a camera
                camera=next((part.camera for part in own if part.channels), ""),
                channels=frozenset[str]().union(*(part.channels for part in own)),
                absolute=True,
            )


def read_links(data: bytes, kind: str = TF) -> Iterator[tuple[str, str, int, int]]:
    """Read parent, child and stamp of the transforms of a message. The numbers are not converted, since most
    are never used.

    Args:
        data: Serialised TFMessage or TransformStamped.
        kind: Type of the message.

    Yields:
        For each transform: parent, child, stamp in nanoseconds, position in ``data`` of its seven numbers.

    Raises:
        RosError: The message is too long or damaged.
    """
    if len(data) > _MAX_BYTES:
        raise RosError(f"a message of {len(data)} bytes; at most {_MAX_BYTES} are read")
    count, at = (unpack("I", data, 4)[0], 8) if kind == TF else (1, 4)
    for _ in range(count):
        seconds, nanoseconds = unpack("iI", data, at)
        parent, at = _frame_name(data, at + 8)
        child, at = _frame_name(data, at)
        at += (4 - at) % 8  # positions count from byte 4
        yield parent, child, seconds * 10**9 + nanoseconds, at
        at += _NUMBERS_SIZE


def _frame_name(data: bytes, at: int) -> tuple[str, int]:
    """Name of a frame at position ``at`` of a serialised message, and the position after the name."""
    end = at + 4 + unpack("I", data, at)[0]
    return str(data[at + 4 : end], "utf-8", "replace").rstrip("\0").strip("/"), end + -end % 4


class Transforms:
    """Tree of the transforms of tf.

    At a time, the pose of a frame in its parent is the last transform up to this time, or else the first
    transform. A static transform is valid at all times. It replaces all earlier transforms of its frame, as
    in tf2 (https://github.com/ros2/geometry2, ``tf2/src/static_cache.cpp`` and ``buffer_core.cpp``).

    Args:
        kept: Number of transforms that are kept for each frame, the newest ones. If None (for a bag), all.
        frames: Names of the frames that keep transforms. If None, all.
    """

    def __init__(self, kept: int | None = _MAX_KEPT, frames: Collection[str] | None = None) -> None:
        self._kept, self._frames = kept, frames
        #: By frame: stamps, and parent and matrix by stamp.
        self._stamps: dict[str, list[int]] = {}
        self._above: dict[str, dict[int, tuple[str, Array]]] = {}
        self._static: set[str] = set()

    def add(self, data: bytes, topic: str = TF_TOPIC, kind: str = TF) -> None:
        """Add a message.

        Args:
            data: Serialised TFMessage or TransformStamped.
            topic: Name of the topic of the message: transforms of ``/tf_static`` are static.
            kind: Type of the message.

        Raises:
            RosError: The message is too long or damaged, or a transform is not valid. Earlier ones stay.
        """
        is_static = topic.rpartition("/")[2] == TF_STATIC_TOPIC
        for parent, child, stamp, at in read_links(data, kind):
            if self._frames is None or child in self._frames:
                self._add(parent, child, stamp, np.array(unpack(_NUMBERS, data, at)), is_static)

    def _add(self, parent: str, child: str, stamp: int, numbers: Array, is_static: bool) -> None:
        position, rotation = numbers[:3], numbers[3:]
        is_pose = within_bounds(numbers) and abs(np.linalg.norm(rotation) - 1) < 1e-3
        if not is_pose or not child or child == parent or max(len(child), len(parent)) > _MAX_NAME:
            raise RosError("a transform is not finite, is no rotation, or has no two frames")
        if child not in self._above and len(self._above) >= _MAX_FRAMES:
            raise RosError(f"more than {_MAX_FRAMES} frames")
        if child not in self._above or is_static or child in self._static:
            self._stamps[child], self._above[child] = [], {}
            (self._static.add if is_static else self._static.discard)(child)
        stamps, above = self._stamps[child], self._above[child]
        if stamp not in above:
            insort(stamps, stamp)
        above[stamp] = parent, transform(quaternion_to_matrix(rotation), position)
        if self._kept is not None and len(stamps) > self._kept:
            del above[stamps.pop(0)]

    def pose(self, frame: str, stamp: int) -> tuple[Array, str] | None:
        """Pose (4, 4) of a frame in ``map``, or in the root of the tree if the frame is not below ``map``;
        and the name of ``map`` or the root. None if the frame is unknown, or the tree has a loop. ``stamp``:
        nanoseconds."""
        name, matrix, seen = frame.strip("/"), np.eye(4), set[str]()
        while name != WORLD_FRAME and name in self._above:
            if name in seen:
                return None
            seen.add(name)
            name, step = self._step(name, stamp)
            matrix = step @ matrix
        return (matrix, name) if seen or name == WORLD_FRAME else None

    def _step(self, name: str, stamp: int) -> tuple[str, Array]:
        """Parent of a frame, and the pose (4, 4) of the frame in its parent."""
        stamps = self._stamps[name]
        return self._above[name][stamps[max(0, bisect_right(stamps, stamp) - 1)]]

    def ambiguous(self) -> Iterator[tuple[str, list[str]]]:
        """Yield frames that have had several parents, each with its first two parents in order of stamps."""
        for child, stamps in self._stamps.items():
            parents = list(dict.fromkeys(self._above[child][stamp][0] for stamp in stamps))
            if len(parents) > 1:
                yield child, parents[:2]

    def moving(self, frame: str) -> str:
        """Go from a frame to its parents until a transform is not static. Returns the frame with this
        transform; if all are static, the frame itself."""
        name, seen = frame, set[str]()
        while name in self._static - seen:
            seen.add(name)
            name, _ = self._step(name, 0)
        return name if name in self._above else frame
