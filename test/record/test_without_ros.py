"""Bags on a machine without ROS: recorded with the same bytes, exported and shown."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from commands import humansim
from conftest import ROOT
from record_support import write_scene

pytest.importorskip("rosbags")
#: Top-level modules of ROS that recording and reading bags could import.
ROS = ("rclpy", "rosidl_parser", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "rosgraph_msgs")
ROS += ("nav_msgs", "sensor_msgs", "shape_msgs", "std_msgs", "visualization_msgs")
SCRIPT = """
import sys
from humansim_ros.cli.main import main
for words in {commands!r}:
    assert main(words) == 0, words
from humansim_ros.view.sources.bag_source import BagViewSource
from humansim_ros.view.sources.source import FrameRequest
source = BagViewSource(sys.argv[1])
frame = source.frame(1, FrameRequest(list(source.cameras)[:1], ["rgb"]))
print(source.frames, sorted(frame.joints), sorted(frame.images), source.messages)
source.close()
"""


def test_a_bag_is_recorded_exported_and_shown_without_ros(tmp_path: Path) -> None:
    scene, hidden = write_scene(tmp_path), tmp_path / "hidden"
    hidden.mkdir()
    for name in ROS:
        (hidden / f"{name}.py").write_text("raise ImportError('no ROS here')")
    bags = tmp_path / "without" / "bag", tmp_path / "with" / "bag"
    record = [
        ["record", str(scene), "--output", str(bag), "--frames", "3", "--jobs", "1", "--topics", "*"]
        for bag in bags
    ]
    data = str(tmp_path / "data")
    commands = [record[0], ["export", str(bags[0]), "--format", "trc", "--output", data]]
    for bag in bags:
        bag.parent.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT.format(commands=commands), bags[0]],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(hidden), str(ROOT)])},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "3 ['anna'] ['noisy'] []"
    assert humansim(*record[1]).returncode == 0
    files = [{file.name: file.read_bytes() for file in bag.iterdir()} for bag in bags]
    assert files[0] == files[1]
