"""Draw the poses of a tracker over the images of a frame (docs/images/tracker.jpg).

python tools/figures/tracker_figure.py SCENE.yaml BAG:/tracker/poses FRAME docs/images/tracker.jpg
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros import Scene, Simulation  # noqa: E402
from humansim_ros.data.evaluation.readers.estimates import read_estimates  # noqa: E402
from humansim_ros.data.evaluation.readers.pose_files import ReadOptions  # noqa: E402
from humansim_ros.people import keypoint_set  # noqa: E402
from humansim_ros.render.pictures import draw_disc, draw_line, draw_text  # noqa: E402
from humansim_ros.types import Image  # noqa: E402

#: RGB, one for each identity.
_COLORS = ((255, 176, 0), (0, 200, 255), (255, 80, 160), (120, 230, 60))
_GAP = 8


def main(scene_file: str, estimate: str, number: int, output: str) -> None:
    scene = Scene.load(scene_file)
    points = keypoint_set("mediapipe33")
    poses = read_estimates([estimate], ReadOptions(points.names))
    with Simulation(scene) as simulation:
        frame = simulation.frame(number)
    people = poses.people[int(np.flatnonzero(poses.times == frame.stamp)[0])]
    order = [poses.names.index(name) for name in points.names]
    images = []
    for name, camera in frame.cameras.items():
        image = np.ascontiguousarray(frame.views[name].rgb)
        for color, (identity, pose) in zip(_COLORS, sorted(people.items()), strict=False):
            pixels, _ = camera.project(pose[order])
            draw_person(image, pixels, points.edges, color)
            draw_text(image, identity, (int(pixels[0, 0]) - 8, int(pixels[0, 1]) - 24), 0.6, color)
        images.append(image)
    column = np.full((images[0].shape[0], _GAP, 3), 255, np.uint8)
    rows = [np.hstack([images[0], column, images[1]]), np.hstack([images[2], column, images[3]])]
    sheet = np.vstack([rows[0], np.full((_GAP, rows[0].shape[1], 3), 255, np.uint8), rows[1]])
    cv2.imwrite(output, sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


def draw_person(
    image: Image, pixels: np.ndarray, edges: tuple[tuple[int, int], ...], color: tuple[int, int, int]
) -> None:
    """Draw the points (K, 2) that are known, and the lines between them."""
    known = np.isfinite(pixels).all(axis=1)
    for first, second in edges:
        if known[first] and known[second]:
            draw_line(image, [pixels[first], pixels[second]], color, 2)
    for pixel in pixels[known]:
        draw_disc(image, pixel, 3, color)


if __name__ == "__main__":
    if len(sys.argv) != 5:
        sys.exit(__doc__)
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4])
