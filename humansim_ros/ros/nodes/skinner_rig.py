"""Node ``skinner_rig``: the skinners of several humans of a scene in one process.

The skinners share the scene, and the data of bodies that several humans have.
"""

from __future__ import annotations

from typing import Any

from humansim_ros.ros.nodes.rig import RigNode
from humansim_ros.ros.nodes.skinner import SkinnerNode
from humansim_ros.ros.processes.node_processes import SKINNER_RIG_NODE
from humansim_ros.scene.core import Scene, skinner_node


class SkinnerRigNode(RigNode):
    """Creates a skinner for each human in parameter ``humans``."""

    def __init__(self, scene: Scene | None = None, **options: Any) -> None:
        super().__init__(SKINNER_RIG_NODE, scene, **options)
        for name in self.chosen("humans", self.scene.actors):
            self.members.append(SkinnerNode(name, scene=self.scene, **self.options_of(skinner_node(name))))
