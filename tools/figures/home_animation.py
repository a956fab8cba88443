"""Render the moving picture of the first page (docs/images/home.webp).

    python tools/figures/home_animation.py docs/images/home.webp

Two cameras with the published joints drawn over their images, the depth and the body parts of the first one.
The scene repeats after the length of the picture, so that it has no visible end.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import imageio_ffmpeg
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros import Frame, Scene, Simulation  # noqa: E402
from humansim_ros.render.pictures import draw_text  # noqa: E402
from humansim_ros.scene.pictures.views import color_channel, draw_joints  # noqa: E402
from humansim_ros.types import Image  # noqa: E402

#: Frames per second, and seconds: four rounds of the walk, two of the wave at this speed.
RATE, SECONDS = 10, 8.0
TILE = (360, 270)
GAP = 6
SCENE = {
    "rate": RATE,
    "humans": {
        "walker": {"motion": {"file": "walk", "position": [0.0, -1.59], "loop": "continue"}},
        "anna": {
            "body": "adult_woman",
            "motion": {"file": "wave", "position": [-0.1, 0.1], "yaw_deg": 10, "speed": 4.2 / 4.0},
        },
    },
    "cameras": {
        "camera_1": {"size": [800, 600], "position": [3.1, 2.3, 1.9], "look_at": [0, 0, 0.85], "fov_deg": 55},
        "camera_2": {"size": [800, 600], "position": [3.1, -2.5, 1.4], "look_at": [0, 0, 0.9], "fov_deg": 55},
    },
    "light": {"shadows": "soft"},
}


def with_joints(scene: Scene, frame: Frame, camera: str) -> Image:
    """Image of a camera with the joints of all people."""
    image = np.ascontiguousarray(frame.views[camera].rgb)
    for name, seen in frame.joints[camera].items():
        skeleton = scene.actors[name].human.skeleton
        image = draw_joints(
            image, seen.pixels, seen.visible, skeleton.joint_names, skeleton.joint_parents, 4.0
        )
    return image


def tile(image: Image, label: str) -> Image:
    """An image at the size of a tile, with its label."""
    small = np.asarray(cv2.resize(image, TILE, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        draw_text(small, label, (8, TILE[1] - 10), 0.45, color, thickness)
    return small


def pictures(scene: Scene) -> Iterator[Image]:
    """The frames of the animation."""
    beside = np.full((TILE[1], GAP, 3), 255, np.uint8)
    between = np.full((GAP, 2 * TILE[0] + GAP, 3), 255, np.uint8)
    with Simulation(scene, channels=("rgb", "depth", "instance", "part")) as simulation:
        for frame in simulation.frames(round(RATE * SECONDS)):
            view = frame.views["camera_1"]
            tiles = [
                tile(with_joints(scene, frame, "camera_1"), "camera_1/image_raw + joints"),
                tile(with_joints(scene, frame, "camera_2"), "camera_2/image_raw + joints"),
                tile(color_channel("depth", view.depth), "camera_1/depth/image"),
                tile(color_channel("part", view.part), "camera_1/part/image"),
            ]
            rows = [np.hstack([tiles[i], beside, tiles[i + 1]]) for i in (0, 2)]
            yield np.vstack([rows[0], between, rows[1]])


def main(output: str) -> None:
    size = (2 * TILE[0] + GAP, 2 * TILE[1] + GAP)
    settings = ["-loop", "0", "-q:v", "55", "-compression_level", "2"]
    writer = imageio_ffmpeg.write_frames(
        output, size, fps=RATE, codec="libwebp_anim", quality=None, macro_block_size=1, pix_fmt_out="yuv420p",
        output_params=settings,
    )  # fmt: skip
    writer.send(None)
    for picture in pictures(Scene.from_dict(SCENE)):
        writer.send(np.ascontiguousarray(picture))
    writer.close()


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
