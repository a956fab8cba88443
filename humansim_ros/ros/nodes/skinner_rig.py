"""Node ``skinner_rig``: the skinners of several humans of a scene in one process.

Each skinner is a node with the same name, topics, parameters and diagnostics as in its own process. The
skinners share the scene, and the data of bodies that several humans have. The node that creates the skinners
has a hidden name.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rclpy.parameter import Parameter

from humansim_ros.ros.nodes.skinner import SkinnerNode
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.ros.processes.node_processes import SKINNER_RIG_NODE
from humansim_ros.ros.processes.runtime import run_node
from humansim_ros.scene.core import Scene, skinner_node


class SkinnerRigNode(SceneNode):
    """Creates a skinner for each human in parameter ``humans``."""

    def __init__(self, scene: Scene | None = None, **options: Any) -> None:
        super().__init__(SKINNER_RIG_NODE, scene, **options)
        description = "Humans of the scene; empty: all"
        requested = self.described_parameter(
            "humans", Parameter.Type.STRING_ARRAY, description, read_only=True
        )
        # a node name from the command line is for this node only
        self.skinners = [
            SkinnerNode(
                name,
                scene=self.scene,
                cli_args=["--ros-args", "-r", f"__node:={skinner_node(name)}"],
                **options,
            )
            for name in dict.fromkeys(requested or self.scene.actors)
        ]

    @property
    def nodes(self) -> Sequence[SceneNode]:
        """This node and its skinners."""
        return [self, *self.skinners]

    def _publish_diagnostics(self) -> None:
        """Do nothing, since the skinners publish diagnostics themselves."""

    def close(self) -> None:
        """Close all skinners."""
        for skinner in self.skinners:
            skinner.close()
            skinner.destroy_node()


def main(scene: Scene | None = None) -> int:
    """Run the node; returns its exit code. ``scene``: scene that its parameter names, if loaded already."""
    return run_node(lambda: SkinnerRigNode(scene=scene))
