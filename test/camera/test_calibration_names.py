"""Cameras with names that are also keys of calibration files, such as color and pose."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from test_calibration_writing import BY_NAME, SIZE, a_camera

from humansim_ros.cameras import read_calibration, write_calibration
from humansim_ros.errors import CameraError

NAMES = ("color", "depth", "camera", "lens", "pose", "left", "right", "k", "p", "K", "R", "t", "cam0", "0")
#: Formats that store no names: cameras are named after their files, counted, or left and right.
NAMELESS = ("mvsnet", "cam", "krtd", "dlt", "kalibr", "zed")
#: Formats that refuse some of these rigs when a file is written.
REFUSING = ("zed", "k4a", "ini", "opencv", "opencv_xml", "opencv_json")


def rigs(multiple: bool) -> list[tuple[str, ...]]:
    """Each name alone, with a plain name, and with the next one."""
    pairs = [*((name, "front") for name in NAMES), *pairwise(NAMES)]
    return [*((name,) for name in NAMES), *(pairs if multiple else [])]


@pytest.mark.filterwarnings("ignore::humansim_ros.errors.HumansimWarning")
@pytest.mark.daily("matrices", "4dassociation", "opencv", "shelf")
@pytest.mark.parametrize("name", BY_NAME)
def test_no_camera_is_lost_by_its_name(tmp_path: Path, name: str) -> None:
    form = BY_NAME[name]
    target = tmp_path / f"rig{form.suffix}"
    refused = []
    for names in rigs(form.multiple):
        cameras = {one: a_camera(i, form, next(iter(form.lenses), None)) for i, one in enumerate(names)}
        if name == "zed":  # the left camera is the world
            cameras = {
                one: replace(cameras[one], size=(1280, 720), R=np.eye(3), t=np.array([-0.12 * i, 0, 0]))
                for i, one in enumerate(names)
            }
        try:
            write_calibration(target, cameras, name)
        except CameraError as error:
            refused.append(error.message)
            continue
        again = read_calibration(target, size=None if form.holds_size else SIZE)
        # npz files have the names, but that of a single camera is not read
        if name not in NAMELESS and (name != "npz" or len(names) > 1):
            assert list(again) == list(names)
        assert len(again) == len(names)
        for camera, other in zip(cameras.values(), again.values(), strict=True):
            assert_allclose(other.K, camera.K, rtol=1e-9, atol=1e-9, err_msg=str(names))
            assert_allclose(other.R, camera.R, atol=1e-9, err_msg=str(names))
            assert_allclose(other.t, camera.t, rtol=1e-9, atol=1e-9, err_msg=str(names))
            coefficients = other.distortion[: len(camera.distortion)]  # k4a pads them with zeros
            assert_allclose(coefficients, camera.distortion, rtol=1e-9, err_msg=str(names))
    assert bool(refused) == (name in REFUSING), refused
    assert len(refused) < len(rigs(form.multiple))
    assert all(re.search("name|needs the left and the right", message) for message in refused), refused


POSE = {"R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "t": [0, 0, 1]}


@pytest.mark.filterwarnings("ignore::humansim_ros.errors.HumansimWarning")
@pytest.mark.parametrize(
    ("color", "depth"), [(POSE, POSE), ({}, {})], ids=["with extrinsics", "with intrinsics only"]
)
def test_color_beside_depth_is_a_camera(
    tmp_path: Path, color: dict[str, object], depth: dict[str, object]
) -> None:
    path = tmp_path / "rig.json"
    k = [[[fx, 0, 320], [0, fx, 240], [0, 0, 1]] for fx in (600, 500)]
    path.write_text(json.dumps({"color": {"K": k[0], **color}, "depth": {"K": k[1], **depth}}))
    cameras = read_calibration(path, size=SIZE)
    assert {name: camera.K[0, 0] for name, camera in cameras.items()} == {"color": 600, "depth": 500}
