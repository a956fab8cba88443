"""Transforms of tf: the topics ``/tf`` and ``/tf_static`` of a scene, and the pose of a frame by time."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from humansim_ros.bags.topics import message_types
from humansim_ros.errors import RosError, within_bounds
from humansim_ros.messages.cameras import transform_message
from humansim_ros.messages.headers import WORLD_FRAME
from humansim_ros.messages.topic import Topic
from humansim_ros.messages.types import TransformStamped
from humansim_ros.rotations import quaternion_to_matrix, transform
from humansim_ros.scene.objects import ObjectPose
from humansim_ros.scene.scene import Scene
from humansim_ros.scene.simulation import Frame
from humansim_ros.types import Array

#: Type of the messages of tf.
TF = "tf2_msgs/msg/TFMessage"
#: Longest message, bytes, most frames, and most transforms of a frame that a running program keeps.
_MAX_BYTES, _MAX_FRAMES, _MAX_KEPT = 1 << 20, 2000, 20_000
_MAX_NAME = 256
#: Topics of transforms that hold for a stamp, and of those that hold for all times.
TF_TOPIC, TF_STATIC_TOPIC = "tf", "tf_static"


def fixed_transform(pose: ObjectPose, parent: str, child: str) -> Topic[ObjectPose]:
    """Transform that never changes, as a part of ``/tf_static``.

    Args:
        pose: Pose of the child frame in the parent frame.
        parent: The parent frame.
        child: The child frame.
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
    """``/tf`` or ``/tf_static``: the transforms of all nodes in one message; none without transforms."""

    @property
    def recorded(self) -> bool:
        """Whether it is recorded unless topics are named."""
        return True

    def sent(self, frame: Frame) -> list[tuple[int, Any]]:
        """Messages of a frame of a simulation, each after the time in nanoseconds at which it is sent."""
        message = self.message(frame)
        return [(frame.stamp, message)] if message.transforms else []


def transform_topics(scene: Scene, parts: Sequence[Topic[Any]]) -> Iterator[TransformTopic]:
    """Topics ``/tf_static`` and ``/tf`` of a scene, if they have a transform.

    A camera that has a rate of its own has a transform in its frames only.

    Args:
        scene: The scene.
        parts: Topics of all its transforms: of a TransformStamped, or of a list of TFMessages. Those that
            have a message per frame are parts of ``/tf``.
    """
    from humansim_ros.messages.types import TFMessage  # needs rosbags without tf2_msgs

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
                *(name, TFMessage, message_of(own), lambda frame: frame),
                latched=not moves,
                per_frame=moves,
                # transforms of people are made of the truth of a camera
                camera=next((part.camera for part in own if part.channels), ""),
                channels=frozenset[str]().union(*(part.channels for part in own)),
                absolute=True,
            )


class Transforms:
    """Tree of the transforms of tf.

    Between two frames, the last transform up to a time counts, or else the first one.

    Args:
        kept: Number of the newest transforms of a frame that are kept; None: all, as of a bag.
    """

    def __init__(self, kept: int | None = _MAX_KEPT) -> None:
        self._kept = kept
        #: By frame: stamps, and parent and matrix by stamp.
        self._stamps: dict[str, list[int]] = {}
        self._above: dict[str, dict[int, tuple[str, Array]]] = {}

    def add(self, data: bytes) -> None:
        """Add a serialised TFMessage.

        Raises:
            RosError: It is too long or damaged, or a transform is impossible; earlier ones are kept.
        """
        if len(data) > _MAX_BYTES:
            raise RosError(f"a message of {len(data)} bytes; at most {_MAX_BYTES} are read")
        try:
            message = message_types().deserialize_cdr(data, TF)
        except Exception as reason:  # rosbags documents no exceptions for damaged messages
            raise RosError(f"a message cannot be read: {type(reason).__name__}") from None
        for each in message.transforms:  # type: ignore[attr-defined]
            self.add_transform(each)

    def add_transform(self, message: Any) -> None:
        """Add a TransformStamped.

        Raises:
            RosError: It is impossible.
        """
        child, parent = str(message.child_frame_id).strip("/"), str(message.header.frame_id).strip("/")
        p, q = message.transform.translation, message.transform.rotation
        position, rotation = np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])
        is_pose = within_bounds([*position, *rotation]) and abs(np.linalg.norm(rotation) - 1) < 1e-3
        if not is_pose or not child or child == parent or max(len(child), len(parent)) > _MAX_NAME:
            raise RosError("a transform is not finite, is no rotation, or has no two frames")
        if child not in self._above and len(self._above) >= _MAX_FRAMES:
            raise RosError(f"more than {_MAX_FRAMES} frames")
        stamp = int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)
        stamps, above = self._stamps.setdefault(child, []), self._above.setdefault(child, {})
        if stamp not in above:
            insort(stamps, stamp)
        above[stamp] = parent, transform(quaternion_to_matrix(rotation), position)
        if self._kept is not None and len(stamps) > self._kept:
            del above[stamps.pop(0)]

    def pose(self, frame: str, stamp: int) -> tuple[Array, str] | None:
        """Pose (4, 4) of a frame in ``map``, or in the frame above all others, whose name is returned too.

        None if the frame is unknown, or the tree has a loop. ``stamp``: nanoseconds.
        """
        name, matrix, seen = frame.strip("/"), np.eye(4), set[str]()
        while name != WORLD_FRAME and name in self._above:
            if name in seen:
                return None
            seen.add(name)
            stamps = self._stamps[name]
            found = stamps[max(0, bisect_right(stamps, stamp) - 1)]
            name, step = self._above[name][found]
            matrix = step @ matrix
        return (matrix, name) if seen else None
