"""Publish transforms for tf2."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

from geometry_msgs.msg import TransformStamped

from humansim_ros.data.messages import TF_STATIC_TOPIC, TF_TOPIC, Topic
from humansim_ros.ros.graph.qos import DATA, LATCHED
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.scene.core import Frame

try:
    from tf2_msgs.msg import TFMessage as TFMessage
except ImportError:  # not on PyPI
    TFMessage = None


class TransformSender:
    """Publishes transforms on ``/tf`` and ``/tf_static``. If the package tf2_msgs is missing, nothing is
    published.

    Args:
        node: The node that publishes.
        parts: Topics with transforms of the node. Transforms that do not change with the frame are published
            at once.
        stamp: Stamp of the transforms that are published at once, nanoseconds.
    """

    def __init__(self, node: SceneNode, parts: Sequence[Topic[Any]], stamp: int) -> None:
        self._node = node
        if TFMessage is not None and any(part.per_frame for part in parts):
            _ = self._dynamic  # subscribers find it before the first frame
        if fixed := [part for part in parts if not part.per_frame]:
            self.send_static(fixed, stamp)

    def send(self, *transforms: TransformStamped) -> None:
        """Publish transforms of one stamp."""
        if TFMessage is not None:
            self._dynamic.publish(TFMessage(transforms=transforms))

    def send_static(self, parts: Sequence[Topic[Any]], stamp: int) -> None:
        """Publish all static transforms of the node. Nodes that subscribe later get the transforms of the
        last call.

        Args:
            parts: Topics of the transforms, with a content that does not depend on the frame.
            stamp: Nanoseconds.
        """
        if TFMessage is not None:
            start = Frame(0, stamp, {}, {})
            self._static.publish(TFMessage(transforms=[part.message(start) for part in parts]))

    @cached_property
    def _dynamic(self) -> Any:
        return self._node.create_publisher(TFMessage, f"/{TF_TOPIC}", DATA)

    @cached_property
    def _static(self) -> Any:
        return self._node.create_publisher(TFMessage, f"/{TF_STATIC_TOPIC}", LATCHED)
