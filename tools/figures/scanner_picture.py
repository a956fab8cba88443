"""Draw the points of a laser scanner from above, and over the image of a camera (docs/images/scanners.jpg).

python tools/figures/scanner_picture.py OUTPUT
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros import Scene, Simulation  # noqa: E402
from humansim_ros.files.reading.assets import resource_path  # noqa: E402
from humansim_ros.geometry import quaternion_to_matrix  # noqa: E402
from humansim_ros.render.pictures import (  # noqa: E402
    INK,
    distinct_hues,
    draw_disc,
    draw_text,
    hsv_colors,
)

#: Frame with which a sweep ends, pixels of the picture, and pixels per metre.
_FRAME, _HEIGHT, _SCALE = 30, 480, 64
_ROOM = (150, 154, 160)


def main() -> int:
    if len(sys.argv) != 2:
        print(__doc__)
        return 2
    scene = Scene.load(resource_path("config/scenes/scanners.yaml"))
    with Simulation(scene, ("rgb", "depth")) as simulation:
        frame = simulation.frame(_FRAME)

    people = hsv_colors(distinct_hues(len(scene.labels)), 230, 220)
    colors = np.vstack([np.array([_ROOM], np.uint8), people])
    above = np.full((_HEIGHT, _HEIGHT, 3), 250, np.uint8)
    image = frame.views["camera_1"].rgb.copy()
    for name, radius in (("lidar", 1), ("shins", 2)):
        sweep = frame.sweeps[name][-1]
        points = sweep.points @ quaternion_to_matrix(sweep.rotation).T + sweep.position
        shown = colors[sweep.instances]
        inside = (points[:, 2] > 0.03) & (points[:, 2] < 2.6)
        pixels = np.array([_HEIGHT / 2, _HEIGHT / 2]) + points[:, [1, 0]] * (-_SCALE, -_SCALE)
        order = np.flatnonzero(inside)[np.argsort(sweep.instances[inside] > 0, kind="stable")]
        for number in order:
            draw_disc(above, pixels[number], radius, tuple(shown[number].tolist()))
        place = np.array([_HEIGHT / 2, _HEIGHT / 2]) - sweep.position[[1, 0]] * _SCALE
        draw_disc(above, place, 6, INK, 2)
        draw_text(above, name, (int(place[0]) + 10, int(place[1]) + 5), 0.5)
        camera = frame.cameras["camera_1"]
        if name == "lidar":
            seen, depth = camera.project(points)
            for number in np.flatnonzero((depth > 0) & (sweep.instances > 0)):
                draw_disc(image, seen[number], 2, tuple(shown[number].tolist()))
    picture = np.hstack([above, image])
    cv2.imwrite(sys.argv[1], picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
