"""Transforms of tf by time, and the pose of a frame in ``map``."""

from __future__ import annotations

from bisect import bisect_right, insort
from typing import Any

import numpy as np

from humansim_ros.bags.topics import message_types
from humansim_ros.errors import RosError, within_bounds
from humansim_ros.messages.headers import WORLD_FRAME
from humansim_ros.rotations import quaternion_to_matrix, transform
from humansim_ros.types import Array

#: Type of the messages of tf.
TF = "tf2_msgs/msg/TFMessage"
#: Longest message, bytes, most frames, and most transforms of a frame that a running program keeps.
_MAX_BYTES, _MAX_FRAMES, _MAX_KEPT = 1 << 20, 2000, 20_000
_MAX_NAME = 256


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
