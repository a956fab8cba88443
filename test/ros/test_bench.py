"""``humansim bench``: how many cameras at how many frames per second a machine holds."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import ROOT
from ros_support import write_scene
from waiting import PATIENCE

from humansim_ros import Scene
from humansim_ros.errors import HumansimError
from humansim_ros.ros.tools.bench import BenchResult, topics_of

#: Two cores that four cameras keep busy at 50 Hz: 40 ms of CPU time per frame.
RESULT = BenchResult(
    cameras={f"camera_{number}": 8.0 for number in range(1, 5)},
    pictures=4.0,
    channels=("rgb",),
    rate=30.0,
    measured_hz=50.0,
    frame_ms=8.0,
    camera_ms=8.0,
    processes=2,
    cores=2,
    other_cores=0.0,
)


def test_a_tenth_of_the_measured_rate_is_kept_free() -> None:
    assert RESULT.max_hz == pytest.approx(45.0)
    assert RESULT.holds
    assert not replace(RESULT, measured_hz=33.0).holds
    assert replace(RESULT, measured_hz=33.4).holds


def test_more_cameras_are_estimated_from_cpu_time() -> None:
    # 45 Hz with 40 ms are 1800 ms in a second; at 30 Hz, 60 ms a frame: 8 ms and 6.5 cameras
    assert RESULT.max_cameras == 6
    assert replace(RESULT, measured_hz=15.0).max_cameras == 1
    assert replace(RESULT, measured_hz=0.0).max_cameras == 0
    for hz in (10.0, 29.0, 33.3, 33.4, 60.0, 200.0):
        result = replace(RESULT, measured_hz=hz)
        assert result.holds == (result.max_cameras >= 4)


def test_the_text_says_what_the_machine_holds() -> None:
    text = RESULT.text()
    assert text.startswith("this machine holds 4 cameras at 30 Hz\n")
    assert "at 30 Hz up to 6 cameras; these 4 at up to 45 Hz" in text
    assert "camera_1 8.0" in text
    assert "other processes" not in text
    assert "other processes used 1.5" in replace(RESULT, other_cores=1.5).text()
    assert "does not hold 4 cameras" in replace(RESULT, measured_hz=10.0).text()
    one = replace(RESULT, cameras={"front": 8.0}).text()
    assert "holds 1 camera at 30 Hz" in one and "this one at up to" in one


def test_json_has_what_the_text_has() -> None:
    data = json.loads(json.dumps(RESULT.to_dict()))
    assert data["holds"] is True and data["max_cameras"] == 6 and data["max_hz"] == pytest.approx(45)
    assert data["cameras"]["camera_4"] == 8.0 and data["channels"] == ["rgb"]


def test_channels_are_topics_of_all_cameras(tmp_path: Path) -> None:
    scene = Scene.load(write_scene(tmp_path))
    assert topics_of(scene, ["rgb", "depth"]) == [
        "/left/image_raw",
        "/right/image_raw",
        "/left/depth/image",
        "/right/depth/image",
    ]
    assert "/left/alpha/second/image" in topics_of(scene, ["alpha"])
    with pytest.raises(HumansimError, match=r"rgbb.*depth"):
        topics_of(scene, ["rgbb"])


@pytest.mark.slow
@pytest.mark.nightly
def test_bench_measures_a_scene(tmp_path: Path) -> None:
    result = subprocess.run(
        [
            *(sys.executable, "-m", "humansim_ros.cli", "bench", str(write_scene(tmp_path))),
            *("--seconds", "2", "--channels", "rgb,part", "--json"),
        ],
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert result.returncode == 0, result.stdout + result.stderr
    data = json.loads(result.stdout)
    assert data["measured_hz"] > 0 and set(data["cameras"]) == {"left", "right"}
    assert data["camera_ms"] > 0 and data["frame_ms"] > 0 and data["rate"] == 20
    assert "Traceback" not in result.stderr
