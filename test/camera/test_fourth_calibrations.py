"""Calibrations of strangers whose true cameras are known (``truth.json``), compared number by number."""

from __future__ import annotations

import json
import warnings
from typing import Any

import numpy as np
import pytest
from conftest import SHARED_DATA, needs_shared_data
from numpy.testing import assert_allclose

from humansim_ros.cameras import Camera, read_calibration
from humansim_ros.errors import CameraError

FOLDER = SHARED_DATA / "fourth" / "calib"
TRUTH: dict[str, Any] = json.loads(path.read_text()) if (path := FOLDER / "truth.json").is_file() else {}
#: Largest differences: pixels of a fitted lens, fraction of K, metres of a centre, coefficients.
FITTED, RELATIVE, METRES, LENS = 1.0, 1e-3, 1e-3, 1e-9
#: Direction in the image of the rays whose pixels are known, radians; 0 is to the right.
AZIMUTHS = {"aria_online_calibration.json": 0.6}


def options(arguments: list[str]) -> dict[str, Any]:
    """Arguments of ``read_calibration`` from those of ``humansim camera show``."""
    given = dict(zip(arguments[1::2], arguments[2::2], strict=True))
    size = tuple(int(side) for side in given["--size"].split("x")) if "--size" in given else None
    unit = float(given["--unit"]) if "--unit" in given else None
    return {"size": size, "unit": unit, "up": given.get("--up")}


def ray(angle: float, azimuth: float) -> list[float]:
    """Direction of a ray in camera axes; both angles in radians."""
    return [np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)]


def assert_is(camera: Camera, wanted: dict[str, Any], azimuth: float) -> None:
    for key, value in (
        ("size", camera.size),
        ("fx", camera.K[0, 0]),
        ("fy", camera.K[1, 1]),
        ("cx", camera.K[0, 2]),
        ("cy", camera.K[1, 2]),
    ):
        if wanted[key] is not None:
            assert_allclose(value, wanted[key], rtol=RELATIVE, err_msg=key)
    if wanted["skew"] is not None:
        assert_allclose(camera.K[0, 1], wanted["skew"], atol=1e-6)
    if wanted["D"] is not None:
        lens = np.trim_zeros(np.array(wanted["D"]), "b")
        assert str(camera.model) == wanted["model"] or not len(lens)
        assert_allclose(camera.distortion[: len(lens)], lens, atol=LENS)
        assert not any(camera.distortion[len(lens) :])
    if wanted["center"] is not None:
        assert_allclose(camera.center, wanted["center"], atol=METRES)
    if wanted["forward"] is not None:
        assert_allclose(camera.R[2], wanted["forward"], atol=1e-3)
    for angle, u, v in wanted.get("pixels", ()):
        normalised = ray(np.radians(angle), azimuth)
        pixel, _ = camera.project([camera.center + camera.R.T @ normalised])
        assert_allclose(pixel[0], (u, v), atol=FITTED)


@needs_shared_data
@pytest.mark.parametrize("name", TRUTH)
def test_a_file_of_a_stranger_has_its_true_cameras(name: str) -> None:
    """Compare a file with the truth, or its refusal where a lens model may be refused by name."""
    wanted: dict[str, Any] = TRUTH[name]["cameras"]
    names = [each["model"].split("refused by the name ")[-1] for each in wanted.values()]
    may_be_refused = any("refused by the name" in each["model"] for each in wanted.values())
    arguments = TRUTH[name]["arguments"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            cameras = read_calibration(FOLDER / arguments[0], **options(arguments))
        except CameraError as error:
            if may_be_refused and names[0] in str(error):
                return
            raise
    if "*" in wanted:
        (cameras["*"],) = cameras.values()
    for camera, each in wanted.items():
        assert camera in cameras, f"{camera} is not one of {list(cameras)}"
        assert_is(cameras[camera], each, AZIMUTHS.get(name, 0.0))
