"""Calibration of a camera node from its image_raw, as of a real camera, gives its camera_info."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from chessboard import (
    BARREL,
    COLUMNS,
    CORNERS,
    ROWS,
    VIEWS,
    Floats,
    assert_finds,
    board,
    calibrate,
    found,
    held_up,
)
from numpy.typing import NDArray
from ros_support import Client

from humansim_ros.cameras import Camera
from humansim_ros.ros.nodes.camera import CameraNode
from humansim_ros.ros.nodes.motion_player import MotionPlayerNode

#: Squares are a separate mesh, with anti-aliased outlines, in front of a white board.
SCENE = """
rate: 20
room: null
objects:
  board: {mesh: board.obj, color: [255, 255, 255], keyframes: moves.xml}
  squares: {mesh: squares.obj, color: [10, 10, 10], keyframes: moves.xml}
cameras:
  eye:
    size: [1280, 960]
    K: [[1080, 0, 652.5], [0, 1066, 469.25], [0, 0, 1]]
    distortion: [-0.361976, 0.110510, 0.001014, 0.000505, 0.0]
    R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    t: [0, 0, 0]
    roi: {x: 24, y: 16, width: 1240, height: 920}
    binning: [2, 2]
    sensor: {encoding: mono8, noise: {}}
"""


def obj(quads: NDArray[np.floating]) -> str:
    """OBJ file of quads (N, 4, 3)."""
    lines = ["v {:g} {:g} {:g}".format(*corner) for corner in quads.reshape(-1, 3)]
    lines += ["f {} {} {} {}".format(*range(4 * n + 1, 4 * n + 5)) for n in range(len(quads))]
    return "\n".join(lines) + "\n"


@pytest.mark.nightly
def test_image_raw_calibrates_to_its_camera_info(tmp_path: Path, ros: None) -> None:
    """A camera node with a region of interest, binning and noise, and a moving board."""
    from rclpy.parameter import Parameter
    from sensor_msgs.msg import CameraInfo, Image

    square = np.array([(0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)]) - (COLUMNS / 2, ROWS / 2, 0)
    places = [(x, y, 0) for x in range(COLUMNS) for y in range(ROWS) if (x + y) % 2 == 0]
    (tmp_path / "squares.obj").write_text(obj(square + np.array(places)[:, None]))
    (tmp_path / "board.obj").write_text(obj(board().vertices[None] + (0, 0, 0.3)))
    (tmp_path / "scene.yaml").write_text(SCENE)
    # camera of the image, to place the board in it
    k = np.array([[540, 0, 314.25], [0, 533, 226.625], [0, 0, 1]])
    camera = Camera((620, 460), k, np.eye(3), np.zeros(3), BARREL)
    rng, keys = np.random.default_rng(1), []
    for number in range(80):
        rotation, middle = held_up(camera, rng)
        turn, place = rotation.as_euler("xyz", degrees=True), middle[0]
        values = (
            f'{name} x="{x}" y="{y}" z="{z}"' for name, (x, y, z) in (("position", place), ("rotation", turn))
        )
        keys.append(f'<frame number="{number}">' + "".join(f"<{value}/>" for value in values) + "</frame>")
    objects = "".join(f'<object name="{name}">{"".join(keys)}</object>' for name in ("board", "squares"))
    animation = f'<animation startframe="0" endframe="79" rate="20" loop="repeat">{objects}</animation>'
    (tmp_path / "moves.xml").write_text(animation)

    scene = Parameter("scene", value=str(tmp_path / "scene.yaml"))
    nodes = [kind(parameter_overrides=[scene], namespace="chess") for kind in (MotionPlayerNode, CameraNode)]
    client = Client("calibrator")
    for node in nodes:
        client.executor.add_node(node)
    client.subscribe(Image, ["/chess/eye/image_raw"])
    client.subscribe(CameraInfo, ["/chess/eye/camera_info"])
    views: dict[int, Floats] = {}

    def enough() -> bool:
        for stamp, image in client.received["/chess/eye/image_raw"].items():
            if stamp not in views:
                pixels = np.frombuffer(image.data, np.uint8).reshape(image.height, image.step)
                assert (image.encoding, image.width, image.height) == ("mono8", 620, 460)
                corners = found(pixels[:, : image.width])
                views[stamp] = np.empty((0, 2)) if corners is None else corners
        return sum(len(corners) > 0 for corners in views.values()) >= 2 * VIEWS

    assert client.spin_until(enough), f"{len(views)} images"
    info: Any = next(iter(client.received["/chess/eye/camera_info"].values()))
    for node in nodes:
        node.close()
        node.destroy_node()
    client.close()

    # as calibration tools do, without views in which corners were confused
    taken = [v for v in views.values() if len(v)]
    boards, corners = [CORNERS] * len(taken), [v.astype(np.float32) for v in taken]
    errors = cv2.calibrateCameraExtended(boards, corners, (620, 460), None, None)[-1].ravel()
    taken = [v for v, error in zip(taken, errors, strict=True) if error < 3 * np.median(errors)]
    assert len(taken) >= VIEWS
    result = calibrate(CORNERS, taken, (620, 460), info.distortion_model)
    # K of the image, as in image_geometry
    k = np.reshape(info.k, (3, 3)) - [[0, 0, info.roi.x_offset], [0, 0, info.roi.y_offset], [0, 0, 0]]
    assert_finds(result, k / [[info.binning_x], [info.binning_y], [1]])
    np.testing.assert_allclose(result.D, info.d, atol=0.01)
