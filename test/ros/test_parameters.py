"""Parameters of all nodes: their types on the command line, in files and over the services."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest
from ros_support import rclpy, write_scene

from humansim_ros.errors import RosError
from humansim_ros.ros.nodes.camera import CameraNode
from humansim_ros.ros.nodes.camera_rig import CameraRigNode
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode
from humansim_ros.ros.nodes.skinner import SkinnerNode
from humansim_ros.ros.processes.node import SceneNode

KINDS = (MotionPlayerNode, SkinnerNode, CameraNode, CameraRigNode)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("parameters"))


def start(kind: type[SceneNode], scene: Path, values: Mapping[str, Any] = MappingProxyType({})) -> SceneNode:
    """Node with parameters, as the command line sets them."""
    given = [rclpy.Parameter(name, value=value) for name, value in {"scene": str(scene), **values}.items()]
    return kind(parameter_overrides=given, namespace="parameters")


def stop(node: SceneNode) -> None:
    node.close()
    node.destroy_node()


def doubles(node: SceneNode) -> Iterator[tuple[Any, int]]:
    """Descriptor of each floating-point parameter of a process, and an integer in its range."""
    for each in node.nodes:
        for name in each.list_parameters([], 0).names:
            descriptor = each.describe_parameter(name)
            if descriptor.type == rclpy.Parameter.Type.DOUBLE.value:
                (range_,) = descriptor.floating_point_range or (None,)
                yield (each, descriptor), 1 if range_ is None else math.ceil(range_.from_value)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_an_integer_is_a_number_for_each_parameter_with_a_decimal_point(
    ros: None, scene: Path, kind: type[SceneNode]
) -> None:
    node = start(kind, scene)
    found = {descriptor.name: number for (_, descriptor), number in doubles(node)}
    assert len(found) >= {MotionPlayerNode: 10, SkinnerNode: 1, CameraNode: 2, CameraRigNode: 4}[kind]
    for (each, descriptor), number in doubles(node):
        result = each.set_parameters_atomically([rclpy.Parameter(descriptor.name, value=number)])
        if descriptor.read_only:
            assert "read-only" in result.reason
            continue
        assert result.successful, result.reason
        value = each.get_parameter(descriptor.name).value
        assert (value, type(value)) == (number, float), descriptor.name
    stop(node)

    node = start(kind, scene, found)
    for (each, descriptor), number in doubles(node):
        value = each.get_parameter(descriptor.name).value
        assert (value, type(value)) == (number, float), descriptor.name
    stop(node)


def test_a_parameter_file_may_have_integers(ros: None, scene: Path, tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(f"/**:\n  ros__parameters: {{scene: {scene}, rate: 15, first: {{speed: 2}}}}\n")
    node = MotionPlayerNode(cli_args=["--ros-args", "--params-file", str(file)], namespace="parameters")
    assert (node.get_parameter("rate").value, node.get_parameter("first.speed").value) == (15.0, 2.0)
    assert node.playback_clock.period == pytest.approx(1e9 / 15)
    stop(node)


@pytest.mark.parametrize("value", [True, "fast", [1.0, 2.0]])
def test_other_types_are_refused_with_words(ros: None, scene: Path, value: Any) -> None:
    with pytest.raises(RosError, match=r"parameter rate: .*expecting type .*DOUBLE"):
        start(MotionPlayerNode, scene, {"rate": value})
    node = start(MotionPlayerNode, scene)
    result = node.set_parameters_atomically([rclpy.Parameter("rate", value=value)])
    assert not result.successful and "DOUBLE" in result.reason, result.reason
    assert node.get_parameter("rate").value == 20.0
    stop(node)
