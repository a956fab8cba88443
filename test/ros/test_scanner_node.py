"""The node of a laser scanner sends the sweeps of a simulation, in lockstep; recordings have them, too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import ros_support  # noqa: F401  # skips without ROS

from humansim_ros import HumansimError
from humansim_ros.data import messages
from humansim_ros.data.engine import run
from humansim_ros.data.messages.topics import ScannerTopics, scene_topics
from humansim_ros.data.recording import SceneRecording
from humansim_ros.ros.nodes.recorder import has_message_per_frame
from humansim_ros.ros.processes.node_processes import scene_processes
from humansim_ros.scene import Needs, Scene, Simulation
from humansim_ros.testing import SceneGraph

highlevel = pytest.importorskip("rosbags.highlevel")
TEXT = """
rate: 20
room: null
humans: {anna: {body: child, motion: walk}}
cameras: {left: {size: [32, 24], position: [4, 0, 1.5], look_at: [0, 0, 1]}}
objects: {wall: {size: [0.2, 8, 3], position: [-2, 0, 1.5], label: true}}
scanners:
  lidar:
    pattern: {elevations_deg: [-12, 4, -4, 12], columns: 200, channel_us: 10}
    rate: 10
    range: [0.2, 20]
    layout: velodyne
    stamp: end
    position: [2.5, 0.3, 0.8]
    noise: 0.02
  plane: {model: hokuyo_utm30lx, position: [2.4, -0.6, 0.3], rotation_deg: [0, 0, 180]}
"""


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    path = tmp_path / "scene.yaml"
    path.write_text(TEXT)
    return Scene.load(path)


def expected(scene: Scene, scanner: str, frames: int) -> list[tuple[Any, Any]]:
    """Points and truth of the sweeps of the first frames."""
    topics = ScannerTopics(scene, scene.scanners[scanner])
    with Simulation(scene, ("depth",)) as simulation:
        return [
            (topics.points.build(sweep, sweep.stamp), topics.truth.build(sweep, sweep.stamp))
            for index in range(frames)
            for sweep in simulation.frame(index, Needs(scanners=[scanner])).sweeps[scanner]
        ]


def values(message: Any) -> Any:
    return list(message.ranges) if hasattr(message, "ranges") else bytes(message.data)


@pytest.mark.slow
def test_live_sweeps_are_those_of_a_simulation(scene: Scene) -> None:
    with SceneGraph(scene, namespace="lab") as graph:
        received = {
            topic: graph.subscribe(topic, every_frame=False)
            for topic in ("lidar/points", "lidar/truth/points", "plane/scan")
        }
        graph.play(5)
        graph.spin_until(lambda: len(received["lidar/truth/points"]) >= 2)
        graph.spin_until(lambda: len(received["plane/scan"]) >= 8)
        pose = graph.wait_for("lidar/extrinsics")
    theirs = expected(scene, "lidar", 5)
    assert len(theirs) == 2
    start = messages.to_nanoseconds(received["lidar/points"][0].header.stamp)
    for number, (points, truth) in enumerate(theirs):
        ours = received["lidar/points"][number], received["lidar/truth/points"][number]
        assert (values(ours[0]), values(ours[1])) == (values(points), values(truth))
        assert ours[0].header.frame_id == "lidar_frame"
        assert ours[0].header.stamp == ours[1].header.stamp
        assert messages.to_nanoseconds(ours[0].header.stamp) == start + number * 100_000_000
    labels = messages.read_scanner_truth(received["lidar/truth/points"][0])["instance"]
    assert {1, 2} <= set(labels.tolist())
    scans = expected(scene, "plane", 5)
    assert [values(each) for each in received["plane/scan"][:8]] == [values(scan) for scan, _ in scans]
    place = pose.transform.translation
    assert (place.x, place.y, place.z) == (2.5, 0.3, 0.8)


@pytest.mark.slow
def test_a_recording_has_the_sweeps_of_a_simulation(scene: Scene, tmp_path: Path) -> None:
    patterns = ["/lidar/*", "/plane/scan"]
    run(SceneRecording.of(scene, 5, patterns), tmp_path / "bag")
    found: dict[str, list[Any]] = {}
    with highlevel.AnyReader([tmp_path / "bag"]) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            found.setdefault(connection.topic, []).append(message)
    theirs = expected(scene, "lidar", 5)
    assert len(found["/lidar/extrinsics"]) == 1
    for topic, number in (("points", 0), ("truth/points", 1)):
        assert [bytes(each.data) for each in found[f"/lidar/{topic}"]] == [
            values(each[number]) for each in theirs
        ]
    scans = [values(scan) for scan, _ in expected(scene, "plane", 5)]
    assert [each.ranges.tolist() for each in found["/plane/scan"]] == scans


def test_a_recorder_in_lockstep_does_not_wait_for_a_sweep_in_each_frame(scene: Scene) -> None:
    topics = [topic for topic in scene_topics(scene) if topic.scanner]
    assert {topic.name for topic in topics} >= {"lidar/points", "lidar/truth/points", "plane/scan"}
    assert not any(map(has_message_per_frame, topics))


def test_each_scanner_has_a_process_of_its_own(scene: Scene) -> None:
    assert scene.path is not None
    processes = scene_processes(scene.path, frame_prefix="lab/")
    found = {each.node_name: each.parameters for each in processes if each.executable == "scanner"}
    assert list(found) == ["lidar", "plane"]
    assert found["lidar"]["scanner"] == "lidar" and found["lidar"]["frame_prefix"] == "lab/"
    assert [each.node_name for each in scene_processes(scene.path, only="scanners")] == ["lidar", "plane"]


def test_a_scanner_has_no_name_of_another_node(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(TEXT.replace("  lidar:", "  skinner_anna:"))
    with pytest.raises(HumansimError, match="skinner of anna"):
        scene_processes(path)
