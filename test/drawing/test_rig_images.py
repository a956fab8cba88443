"""Images of rigs: cameras at their positions, coverage, and rigs that cannot be drawn."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from humansim_ros.camera.rigs import Optics, dome, ring
from humansim_ros.drawing.rigs import coverage_image, rig_image
from humansim_ros.errors import CameraError

TARGET = np.array([0.5, -1.0, 1.1])
OPTICS = Optics((640, 480), np.radians(50))
FISHEYE = Optics((640, 480), np.radians(170), (0.02, -0.005, 0.001, 0.0), "equidistant")


def test_cameras_are_drawn_at_their_positions() -> None:
    cameras = ring(5, 3, 2.2, TARGET, OPTICS) | {"inner": OPTICS.camera((1, 0, 1), (0, 0, 1))}
    above = rig_image(cameras)[60:, 44:620].astype(int)
    colored = (np.ptp(above, axis=-1) > 50).astype(np.uint8)
    count, _, _, dots = cv2.connectedComponentsWithStats(cv2.erode(colored, np.ones((5, 5), np.uint8)))
    assert count == 1 + 6
    places = np.array([camera.center for camera in cameras.values()])[:, :2] * [1, -1]
    # one scale and one shift take all cameras to their dots
    scale = np.ptp(dots[1:], axis=0) / np.ptp(places, axis=0)
    assert scale[0] == pytest.approx(scale[1], rel=0.01)
    drawn = (places - places.min(0)) * scale + dots[1:].min(0)
    for place in drawn:
        assert np.linalg.norm(dots[1:] - place, axis=1).min() < 1


def test_one_camera_many_cameras_and_distant_cameras_are_drawn() -> None:
    far = OPTICS.camera((500, -300, 2), (499, -300, 1))
    for cameras in (
        {"far": far},
        {"far": far, "near": OPTICS.camera((1, 0, 1), (0, 0, 1))},
        dome(40, 4, TARGET, FISHEYE),
    ):
        assert np.ptp(rig_image(cameras)[60:, :1200]) > 100
    assert coverage_image({"far": far}).shape[1] == 2 * 770
    with pytest.raises(CameraError, match="no cameras"):
        rig_image({})
    with pytest.raises(CameraError, match="in metres"):
        rig_image({"lost": OPTICS.camera((5e6, 0, 0), (0, 0, 0))})
    for area in ((0, 0, 0, 1), (0, 0, np.nan, 1), (0, 0, 1e9, 1)):
        with pytest.raises(CameraError) as caught:
            coverage_image({"far": far}, area=area)
        assert caught.value.key == "area"
