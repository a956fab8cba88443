"""The commands ``humansim camera rig`` and ``plot``."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import humansim

from humansim_ros.cameras import read_calibration
from humansim_ros.cameras.camera.rigs import Optics, Rig
from humansim_ros.scene import Scene

TARGET = np.array([0.5, -1.0, 1.1])


@pytest.mark.slow
def test_a_rig_is_a_scene_and_camera_info_files_and_can_be_drawn(tmp_path: Path) -> None:
    done = humansim(
        "camera",
        "rig",
        "--stereo",
        0.2,
        "--distortion",
        "-0.3 0.1 0 0",
        "--look-at",
        0.5,
        -1,
        1.1,
        "-o",
        tmp_path / "rig",
    )
    assert done.returncode == 0, done.stderr
    optics = Optics(distortion=(-0.3, 0.1, 0, 0))
    wanted = Rig(TARGET, 4, 1.8, optics).stereo(0.2)
    scene = Scene.load(tmp_path / "rig" / "scene.yaml")
    for name, camera in wanted.items():
        info = read_calibration(tmp_path / "rig" / "camera_info" / f"{name}.yaml")[name]
        for found in (scene.cameras[name], read_calibration(tmp_path / "rig")[name]):
            np.testing.assert_allclose(found.P, camera.P, atol=1e-9)
            for part in (found, info):
                assert (part.size, part.distortion, part.model) == (
                    camera.size,
                    camera.distortion,
                    camera.model,
                )
                np.testing.assert_allclose(part.rectified_projection, camera.rectified_projection, atol=1e-9)
    # nothing of the room is in the way of the cameras
    assert scene.config.room is not None
    assert scene.config.room.size[0] / 2 > 4.5 + 1

    for option in ((), ("--coverage", "--area", -2, -2, 2, 2)):
        drawn = humansim("camera", "plot", tmp_path / "rig", "-o", tmp_path / "rig.png", *option)
        assert drawn.returncode == 0, drawn.stderr
    assert cv2.imread(str(tmp_path / "rig.png")).shape[1] == 2 * 770


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--ring", 8, "--dome", 3], "--ring and --dome"),
        ([], "give one of --ring"),
        (["--grid", "2by3"], "such as 2x4"),
        (["--dome", 8, "--height", 2], "--height"),
        (["--ring", 8, "--distortion", "strong"], "needs numbers"),
        (["--ring", 8, "--radius", "nan"], "must be finite numbers"),
        (["--ring", 8, "--radius", -1], "radius: must be above zero"),
    ],
)
def test_wrong_options_of_a_rig_are_explained(options: list, said: str, tmp_path: Path) -> None:
    done = humansim("camera", "rig", *options, "-o", tmp_path / "rig")
    assert done.returncode == 2 and re.search(said, done.stderr), done.stderr
    assert not (tmp_path / "rig").exists()
