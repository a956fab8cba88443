"""The promises of the README: its code works as printed, its links lead somewhere, its topics exist."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

from conftest import ROOT
from waiting import PATIENCE, wait_until

from humansim_ros.render.channels import CHANNEL_TABLE

README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)

#: The cameras that the README's tracker listens to, small.
SCENE = """
room: null
humans: {walker: {motion: {file: walk, position: [0, -1.59], loop: continue}}}
cameras:
  camera_1: {size: [64, 48], position: [3, 2.6, 2], look_at: [0, 0, 1]}
  camera_2: {size: [64, 48], position: [-3, 2.6, 2], look_at: [0, 0, 1]}
"""


def test_the_tracker_of_the_readme_hears_the_cameras(tmp_path: Path) -> None:
    from ros_support import write_scene

    tracker = tmp_path / "tracker.py"
    tracker.write_text(next(block for block in BLOCKS if "rclpy" in block))
    nodes = subprocess.Popen(
        [sys.executable, "-m", "humansim_ros.cli", "run", str(write_scene(tmp_path, SCENE))],
        stdout=subprocess.DEVNULL,
    )
    with (tmp_path / "heard").open("w") as output:
        listening = subprocess.Popen([sys.executable, "-u", str(tracker)], stdout=output, env={**os.environ})

        def heard() -> str:
            return (tmp_path / "heard").read_text()

        both = wait_until(lambda: "camera_1" in heard() and "camera_2" in heard())
        for process in (listening, nodes):
            process.send_signal(signal.SIGINT)
        assert nodes.wait(PATIENCE) == 0
        listening.wait(PATIENCE)
    assert both
    assert re.search(r"camera_1_optical_frame .*sec=\d+.* 64 48", heard()), heard()[:500]


def test_every_file_the_documents_link_to_exists() -> None:
    for document in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))):
        for target in re.findall(r"\]\(([^)#]+)\)", document.read_text()):
            if "://" not in target:
                assert (document.parent / target).exists(), f"{document.name} links to {target}"


def test_the_readme_lists_the_topics_that_the_nodes_have() -> None:
    source = "".join(path.read_text() for path in (ROOT / "humansim_ros" / "ros").rglob("*.py"))
    topics = [channel.topic.format(body="<name>") for channel in CHANNEL_TABLE.values()]
    topics += [channel.rectified_topic for channel in CHANNEL_TABLE.values()]
    source += " ".join([*topics, *(f"{topic.rpartition('/')[0]}/camera_info" for topic in topics)])
    for topic in re.findall(r"`/<camera>/([a-z_/]+)`", README):
        assert topic in source, topic
    for topic in re.findall(r"`/humans/<id>/([a-z_/]+)`", README):
        assert f"/{topic}" in source, topic


def test_the_scene_of_the_documents_loads_and_every_key_is_described(tmp_path: Path) -> None:
    from humansim_ros.scene import Scene, config

    text = (ROOT / "docs" / "scene.md").read_text()
    example = re.search(r"```yaml\n(.*?)```", text, re.DOTALL)
    assert example
    scene = tmp_path / "scene.yaml"
    scene.write_text(example.group(1))
    assert len(Scene.load(scene).cameras) == 2
    sections = (config.HumanConfig, config.MotionConfig, config.ObjectConfig, config.CameraConfig)
    cameras = (config.RigConfig, config.TrajectoryConfig, config.RegionConfig)
    for section in (*sections, *cameras, config.RoomConfig, config.TimeConfig):
        for key in section.model_fields:
            assert f"`{key}`" in text or f".{key}`" in text, key
