"""``humansim demo SCENE``: pictures of any scene."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import ros_support  # noqa: F401  # own ROS domain; skips without ROS
from conftest import ROOT
from rich.console import Console
from waiting import PATIENCE

from humansim_ros.errors import HumansimError
from humansim_ros.ros.tools import demo

#: Cameras of different sizes and encodings, in a room with one colourful object and a live human.
LIVE = """
rate: 10
humans:
  anna: {body: child, motion: live}
cameras:
  wide: {size: [200, 100], position: [3, 0, 1.2], look_at: [0, 0, 0.7], sensor: {encoding: bgr8}}
  tall: {size: [90, 160], position: [0, 3, 1.2], look_at: [0, 0, 0.7], sensor: {encoding: mono8}}
  bayer: {size: [120, 120], position: [-3, 0, 1.2], look_at: [0, 0, 0.7], sensor: {encoding: bayer_rggb8}}
"""
#: Nothing moves, and nobody is there. The images of one camera have wrong stamps.
EMPTY = """
rate: 10
cameras:
  left: {size: [120, 90], position: [3, 1, 1.2], look_at: [0, 0, 0.7], faults: {clock: 0.013}}
  right: {size: [120, 90], position: [3, -1, 1.2], look_at: [0, 0, 0.7]}
"""


def test_a_short_recording_lasts_until_a_frame_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a slow machine the first frame with all cameras may arrive after the asked duration."""
    whole: list[int] = []
    spins = count()

    def spin(_: float) -> None:
        if next(spins) == 50:
            whole.append(1)

    thumbnails = SimpleNamespace(whole=lambda: whole)
    recorder = SimpleNamespace(sheet={"/c/image_raw": 0}, thumbnails=thumbnails, spin=spin)
    recorder.reset = recorder.wait_for_all = lambda *_: None
    nodes = SimpleNamespace(dead=lambda: "")
    assert demo._record(nodes, recorder, 0.0, Console(quiet=True)) is not None  # type: ignore[arg-type]
    assert whole == [1]

    whole.clear()
    monkeypatch.setattr(demo, "_START_LIMIT", 0.01)
    demo._record(nodes, recorder, 0.0, Console(quiet=True))  # type: ignore[arg-type]
    with pytest.raises(HumansimError, match="the machine is too slow for this scene"):
        demo._contact_sheet(None, recorder)  # type: ignore[arg-type]


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", ["live", "empty"])
def test_the_demo_draws_any_scene(tmp_path: Path, name: str) -> None:
    scene = tmp_path / f"{name}.yaml"
    scene.write_text({"live": LIVE, "empty": EMPTY}[name])
    pictures = tmp_path / "pictures"
    result = subprocess.run(
        [
            sys.executable,
            "-m",
            "humansim_ros.cli",
            "demo",
            str(scene),
            "--seconds",
            "2",
            "-o",
            str(pictures),
        ],
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert result.returncode == 0, result.stdout + result.stderr
    count = 3 if name == "live" else 2
    assert f"frames with all {count} cameras at equal stamps" in result.stdout
    sheet = cv2.imread(str(pictures / "contact_sheet.png"))
    assert sheet.std() > 20
    video = cv2.VideoCapture(str(pictures / f"{name}.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) >= 1
    _, frame = video.read()
    size = (960, 720) if name == "live" else (960, 360)  # two columns, and as many rows as are needed
    assert (frame.shape[1], frame.shape[0]) == size
    if name == "live":
        # the fourth place is empty; the codec mixes colours in the blocks of 16 pixels at its edge
        assert not frame[376:, 496:].any()
        wide, tall = frame[:360, :480].astype(int), frame[:360, 480:].astype(int)
        colourful = [np.ptp(part, axis=-1).mean() for part in (wide[100:260], tall[:, 180:300])]
        assert colourful[0] > 5 > colourful[1]  # bgr8 is in colour, mono8 is not
