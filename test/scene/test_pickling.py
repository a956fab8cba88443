"""Scenes and frames that are pickled: another process gets the same bytes of them."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT, TESTS
from everything import all_scanners, everything
from frame_digest import INDEX, digest, simulated
from render_scenes import renderer_or_skip
from waiting import PATIENCE

from humansim_ros import Scene, Simulation
from humansim_ros.errors import RenderError

SCENES = sorted((ROOT / "config" / "scenes").glob("*.yaml"))


def loaded(name: str, folder: Path) -> Scene:
    if name == "everything":
        return Scene.from_dict(everything(folder))
    if name == "scanners":
        humans = {"anna": {"motion": {"file": "walk", "position": [0.5, 0]}}}
        camera = {"position": [3, 0, 1.5], "look_at": [0, 0, 1], "size": [32, 24]}
        return Scene.from_dict({"humans": humans, "cameras": {"front": camera}, "scanners": all_scanners()})
    return Scene.load(ROOT / "config" / "scenes" / name)


def test_labels_follow_the_order_of_features(tmp_path: Path) -> None:
    """Humans, objects of the file, chairs and tables, the robot, clutter: labels of data sets stay."""
    scene = loaded("everything", tmp_path)
    assert list(scene.objects) == ["ball", "box", "file", "ed_chair", "robot", "clutter_1", "clutter_2"]
    labels = list(scene.labels.values())
    assert labels == sorted(labels)


@pytest.mark.slow
@pytest.mark.daily("scanners", "demo.yaml")
@pytest.mark.parametrize("name", ["everything", "scanners", *(path.name for path in SCENES)])
def test_another_process_gets_the_same_frame_and_makes_it_of_the_scene(name: str, tmp_path: Path) -> None:
    renderer_or_skip().close()
    scene = loaded(name, tmp_path)
    pickled = {"scene": pickle.dumps(("scene", scene, None))}
    frame = simulated(scene)
    expected = digest(scene, frame)
    # the scene after use: what is cached is pickled, too
    pickled["frame"] = pickle.dumps(("frame", scene, frame))
    for kind, data in pickled.items():
        (tmp_path / f"{kind}.pkl").write_bytes(data)
    run = subprocess.run(
        [
            sys.executable,
            TESTS / "scene" / "frame_digest.py",
            *(tmp_path / f"{kind}.pkl" for kind in pickled),
        ],
        env={**os.environ, "PYTHONHASHSEED": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=20 * PATIENCE,
    )
    assert run.returncode == 0, run.stderr
    for kind, line in zip(pickled, run.stdout.splitlines(), strict=True):
        found = json.loads(line)
        assert [topic for topic in expected if found[topic] != expected[topic]] == [], kind
    if name == "scanners":
        assert all(frame.sweeps[scanner] for scanner in scene.scanners)


DEPTH: dict[str, Any] = {
    "room": None,
    "humans": {"anna": {"motion": "walk"}},
    "cameras": {
        "front": {
            "size": [64, 48],
            "position": [3, 0, 1.6],
            "look_at": [0, 0, 0.9],
            "depth_sensor": {"preset": "kinect_v2", "size": [64, 48]},
        }
    },
}


def test_a_frame_is_pickled_with_the_depth_that_is_rendered_on_access() -> None:
    renderer_or_skip().close()
    scene = Scene.from_dict(DEPTH)
    with Simulation(scene, ("rgb",)) as simulation:
        frame = simulation.frame(INDEX)
        copied = pickle.loads(pickle.dumps(frame))
        closed = simulation.frame(INDEX + 1)
    assert (copied.depth_sensors["front"].measured == frame.depth_sensors["front"].measured).all()
    # what was never rendered is an error where it is asked for; the frame has all else
    late = pickle.loads(pickle.dumps(closed))
    assert (late.views["front"].rgb == closed.views["front"].rgb).all()
    with pytest.raises(RenderError, match=r"access frame\.depth_sensors before"):
        late.depth_sensors["front"]
    both = frame.keypoint_positions["coco17"], pickle.loads(pickle.dumps(frame)).keypoint_positions["coco17"]
    assert (both[0]["anna"] == both[1]["anna"]).all()
