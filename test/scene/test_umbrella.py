"""A new feature is a folder and two lines: the umbrella of CONTRIBUTING.md, as a patch for a copy."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

PATCH = Path(__file__).with_name("umbrella.patch")
#: Prints what a scene with umbrellas shows.
PROGRAM = """
import json, sys
import numpy as np
from humansim_ros import Scene, Simulation
from humansim_ros.scene.checks.checks import check_scene
from humansim_ros.scene.config import schema_text

cameras = {"front": {"size": [160, 120], "position": [3.2, 2.2, 1.5], "look_at": [-0.3, -0.3, 1.1]}}
walk = {"file": "walk", "position": [-1.5, 0]}
stand = {"file": "stand", "position": [0.6, -0.8], "yaw_deg": 120}
scene = Scene.from_dict({
    "rate": 10, "room": None, "cameras": cameras,
    "humans": {
        "anna": {"body": "adult_woman", "motion": walk, "umbrella": {"color": [200, 40, 40]}},
        "ben": {"motion": stand, "umbrella": {"hand": "left"}},
    },
})
with Simulation(scene, channels=("rgb", "instance", "depth")) as simulation:
    frame = simulation.frame(10)
view, found = frame.views["front"], {}
for human, side in (("anna", "right"), ("ben", "left")):
    label = frame.labels[f"{human}_umbrella"]
    rows = np.flatnonzero((view.instance == label).any(axis=1))
    head = np.flatnonzero((view.instance == frame.labels[human]).any(axis=1))
    palm = scene.actors[human].palms_at(side, np.array([1.0]))[0]
    pose = frame.objects[f"{human}_umbrella"]
    found[human] = {
        "above": int(head[0] - rows[0]),
        "from palm": float(np.linalg.norm(pose.position - palm)),
        "velocity": pose.velocity is not None,
        "color": view.rgb[view.instance == label].mean(axis=0).tolist(),
    }
try:
    from humansim_ros.data.messages import object_message
except ImportError:  # without rclpy
    found["triangles"] = 1
else:
    item = scene.objects["anna_umbrella"]
    found["triangles"] = len(object_message(item, frame.objects[item.name], 1).points)
found["findings"] = [finding.message for finding in check_scene(scene)]
found["schema"] = '"umbrella"' in schema_text()
print(json.dumps(found))
"""


@pytest.mark.skipif(shutil.which("git") is None, reason="git applies the patch")
def test_a_folder_and_two_lines_are_a_feature(tmp_path: Path) -> None:
    hidden = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "humansim_ros", tmp_path / "humansim_ros", ignore=hidden)
    for name in ("assets", "config", "package.xml"):
        (tmp_path / name).symlink_to(ROOT / name)
    subprocess.run(["git", "apply", str(PATCH)], cwd=tmp_path, check=True)
    own = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=tmp_path, env=own, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    for human in ("anna", "ben"):
        assert found[human]["above"] > 5  # pixels of the umbrella above the head
        assert found[human]["from palm"] < 1e-6
        assert found[human]["velocity"]
    red, _, blue = found["anna"]["color"]
    assert red > 2 * blue and found["triangles"] > 0
    assert found["findings"] == [] and found["schema"]


def test_the_patch_changes_two_lines_outside_its_folder() -> None:
    text = PATCH.read_text()
    files = re.split(r"(?m)^diff --git a/\S+ b/", text)[1:]
    changed = {each.split("\n")[0]: re.findall(r"(?m)^[+-](?![+-]).*", each) for each in files}
    outside = {name: lines for name, lines in changed.items() if "/features/umbrella/" not in name}
    lines = [line for each in outside.values() for line in each if "import" not in line]
    assert len(lines) == 2 and all(line.startswith("+") for line in lines)


def test_contributing_shows_code_of_the_patch() -> None:
    section = (ROOT / "CONTRIBUTING.md").read_text().split("### a feature")[1].split("###")[0]
    code = "".join(re.findall(r"(?s)```python\n(.*?)```", section))
    added = {line[1:].strip() for line in PATCH.read_text().splitlines() if line.startswith("+")}
    lines = [line.strip() for line in code.splitlines() if line.strip()]
    assert len(lines) > 15 and [line for line in lines if line not in added] == []
