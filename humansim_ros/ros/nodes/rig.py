"""Base class of the nodes that create other nodes of a scene in their process."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

from rclpy.parameter import Parameter

from humansim_ros.errors import SceneError, unknown
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.scene.core import Scene


class RigNode(SceneNode):
    """Creates nodes, each with the same name, topics, services, parameters and diagnostics as in its own
    process. This node itself has a hidden name.

    Attributes:
        members: The created nodes.
    """

    def __init__(self, name: str, scene: Scene | None = None, **options: Any) -> None:
        super().__init__(name, scene, **options)
        self._options = options
        self.members: list[Any] = []

    def chosen(self, parameter: str, known: Collection[str]) -> Sequence[str]:
        """Names in a parameter such as ``cameras``. If it is empty, all ``known`` names. Raises SceneError
        for an unknown name."""
        description = f"{parameter.capitalize()} of the scene; empty: all"
        requested = self.described_parameter(
            parameter, Parameter.Type.STRING_ARRAY, description, read_only=True
        )
        for name in requested or ():
            if name not in known:
                text = unknown(parameter.removesuffix("s"), name, known, "the scene")
                raise SceneError(text, path=self.scene.path, key=parameter)
        return list(dict.fromkeys(requested or known))

    def options_of(self, name: str) -> dict[str, Any]:
        """Options of a created node. ``name``: its name; one from the command line is for this node only."""
        return {**self._options, "cli_args": ["--ros-args", "-r", f"__node:={name}"]}

    @property
    def nodes(self) -> Sequence[SceneNode]:
        """This node and the nodes that it has created."""
        return [self, *self.members]

    def _publish_diagnostics(self) -> None:
        """Do nothing, since the members publish diagnostics themselves."""

    def close(self) -> None:
        """Close all members."""
        for node in self.members:
            node.close()
            node.destroy_node()
