"""Layouts of RViz and Foxglove: each topic is one that the scene publishes, with its type and its QoS."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import pytest
import ros_support  # noqa: F401  (skips where ROS is missing)
import yaml
from conftest import ROOT
from rclpy.qos import QoSDurabilityPolicy, QoSReliabilityPolicy

from humansim_ros.data.messages.topic import Topic
from humansim_ros.data.messages.topics import scene_topics
from humansim_ros.ros.graph.qos import offered_profile
from humansim_ros.ros.processes.scene_names import SceneNames, read_names
from humansim_ros.ros.tools.viewer_layouts import foxglove_layout, rviz_layout
from humansim_ros.scene import Scene

DEMO = ROOT / "config" / "scenes" / "demo.yaml"
#: Displays of rviz_default_plugins of Jazzy that layouts use, with their types.
DISPLAYS = {
    "Camera": "sensor_msgs/msg/Image",
    "CameraInfo": "sensor_msgs/msg/CameraInfo",
    "Grid": None,
    "Image": "sensor_msgs/msg/Image",
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
    "TF": None,
}
TOOLS = {
    "MoveCamera",
    "Select",
    "FocusCamera",
    "Measure",
    "Interact",
    "SetGoal",
    "SetInitialPose",
    "PublishPoint",
}
RVIZ_PANELS = {"Displays", "Help", "Selection", "Time", "Tool Properties", "Transformation", "Views"}
#: Panels of Foxglove (https://docs.foxglove.dev/docs/visualization/panels).
FOXGLOVE_PANELS = {"3D", "Image", "RawMessages", "TransformTree"}
#: Types that its 3D panel draws.
IN_3D = {"visualization_msgs/msg/MarkerArray", "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"}


@pytest.fixture(scope="module")
def topics() -> Mapping[str, Topic[Any]]:
    return {f"/{topic.name}": topic for topic in scene_topics(Scene.load())}


def rviz_displays(layout: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    for display in layout["Visualization Manager"]["Displays"]:
        package, _, kind = display["Class"].partition("/")
        assert package == "rviz_default_plugins"
        yield kind, display


def leaves(mosaic: Any) -> list[str]:
    """Panels of a tree of splits."""
    if isinstance(mosaic, str):
        return [mosaic]
    assert mosaic["direction"] in ("row", "column") and 0 < mosaic["splitPercentage"] < 100
    return leaves(mosaic["first"]) + leaves(mosaic["second"])


def test_the_files_are_the_layouts_of_the_demo_scene() -> None:
    names = read_names(DEMO)
    written = [(ROOT / "config" / name).read_text() for name in ("humansim.rviz", "humansim_foxglove.json")]
    assert written == [rviz_layout(names), foxglove_layout(names)]


def test_rviz_subscribes_to_topics_of_the_scene_as_they_are_published(
    topics: Mapping[str, Topic[Any]],
) -> None:
    layout = yaml.safe_load((ROOT / "config" / "humansim.rviz").read_text())
    kinds = []
    for kind, display in rviz_displays(layout):
        kinds.append(kind)
        assert display["Enabled"] is display["Value"] is True
        if DISPLAYS[kind] is None:
            assert "Topic" not in display
            continue
        wanted = display["Topic"]
        topic = topics[wanted["Value"]]
        assert topic.type_name == DISPLAYS[kind], display["Name"]
        reliability = wanted["Reliability Policy"].upper().replace(" ", "_")
        durability = wanted["Durability Policy"].upper().replace(" ", "_")
        # a subscriber gets nothing from a publisher that offers less
        offered = offered_profile(topic)
        assert QoSReliabilityPolicy[reliability] in (offered.reliability, QoSReliabilityPolicy.BEST_EFFORT)
        assert QoSDurabilityPolicy[durability] in (offered.durability, QoSDurabilityPolicy.VOLATILE)
        assert wanted["History Policy"] == "Keep Last" and wanted["Depth"] >= 1
    assert set(kinds) == set(DISPLAYS) and kinds.count("Image") == kinds.count("CameraInfo") == 4
    manager = layout["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == "map"
    assert {tool["Class"].split("/")[1] for tool in manager["Tools"]} <= TOOLS
    assert {panel["Class"].removeprefix("rviz_common/") for panel in layout["Panels"]} <= RVIZ_PANELS
    assert manager["Views"]["Current"]["Class"] == "rviz_default_plugins/Orbit"


def test_the_camera_display_finds_the_calibration_beside_its_image(topics: Mapping[str, Topic[Any]]) -> None:
    layout = yaml.safe_load((ROOT / "config" / "humansim.rviz").read_text())
    (camera,) = (display for kind, display in rviz_displays(layout) if kind == "Camera")
    beside = camera["Topic"]["Value"].rpartition("/")[0] + "/camera_info"
    assert topics[beside].type_name == "sensor_msgs/msg/CameraInfo"


def test_the_fields_that_colour_points_exist(topics: Mapping[str, Topic[Any]]) -> None:
    from humansim_ros.data.messages.camera_truth import JOINT_POINT

    rviz = yaml.safe_load((ROOT / "config" / "humansim.rviz").read_text())
    (cloud,) = (display for kind, display in rviz_displays(rviz) if kind == "PointCloud2")
    foxglove = json.loads((ROOT / "config" / "humansim_foxglove.json").read_text())
    in_3d = foxglove["configById"]["3D!world"]["topics"]
    (field,) = (settings["colorField"] for settings in in_3d.values() if "colorField" in settings)
    assert {cloud["Channel Name"], field} <= set(JOINT_POINT.names or ())


def test_foxglove_subscribes_to_topics_of_the_scene(topics: Mapping[str, Topic[Any]]) -> None:
    layout = json.loads((ROOT / "config" / "humansim_foxglove.json").read_text())
    panels = layout["configById"]
    assert sorted(leaves(layout["layout"])) == sorted(panels)
    assert {name.split("!")[0] for name in panels} == FOXGLOVE_PANELS
    in_3d = panels["3D!world"]["topics"]
    assert {topics[name].type_name for name in in_3d} == IN_3D
    assert all(settings["visible"] for settings in in_3d.values())
    assert panels["3D!world"]["followTf"] == "map"
    images = [settings["imageMode"] for name, settings in panels.items() if name.startswith("Image!")]
    assert len(images) == 4
    for mode in images:
        assert topics[mode["imageTopic"]].type_name == "sensor_msgs/msg/Image"
        assert topics[mode["calibrationTopic"]].type_name == "sensor_msgs/msg/CameraInfo"
        (overlay,) = mode["annotations"]
        assert topics[overlay].type_name == "visualization_msgs/msg/ImageMarker"
        # only annotations with the stamp of the image are drawn, and they have it
        assert mode["synchronize"] and not topics[overlay].faulty
    raw = next(settings for name, settings in panels.items() if name.startswith("RawMessages!"))
    assert raw["topicPath"] in topics


@pytest.mark.parametrize(
    "names",
    [
        SceneNames((), ("eye",)),
        SceneNames(("anna",), ()),
        SceneNames(("anna", "ben"), tuple(f"eye_{number}" for number in range(12))),
    ],
)
def test_layouts_of_other_scenes_name_their_topics_in_the_namespace(names: SceneNames) -> None:
    rviz = yaml.safe_load(rviz_layout(names, "lab"))
    used = {display["Topic"]["Value"] for _, display in rviz_displays(rviz) if "Topic" in display}
    wanted = {f"/lab/humans/{name}/markers" for name in names.humans}
    wanted |= {f"/lab/{name}/camera_info" for name in names.cameras}
    wanted |= {f"/lab/{name}/image_raw" for name in names.cameras[:4]}
    wanted |= {f"/lab/{name}/joints" for name in names.cameras[:1]}
    assert used == wanted
    foxglove = json.loads(foxglove_layout(names, "lab"))
    panels = foxglove["configById"]
    assert sorted(leaves(foxglove["layout"])) == sorted(panels)
    assert set(panels["3D!world"]["topics"]) == {name for name in wanted if not name.endswith("image_raw")}


@pytest.mark.parametrize("make", [rviz_layout, foxglove_layout])
def test_a_namespace_may_contain_names_of_the_demo_scene(make: Any) -> None:
    names = SceneNames(humans=("anna",), cameras=("left",))
    text = make(names, "walker_at_camera_1")
    assert text.count("walker_at_camera_1") == make(names).count(" /") + make(names).count('"/') > 4
    assert "walker" not in text.replace("walker_at_camera_1", "")
