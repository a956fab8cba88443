"""Draw every keypoint set on a built-in human (docs/images/keypoints.jpg).

python tools/figures/keypoint_figure.py docs/images/keypoints.jpg
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros import Scene, Simulation  # noqa: E402
from humansim_ros.body.skeleton import side_of  # noqa: E402
from humansim_ros.drawing.canvas import (  # noqa: E402
    INK,
    PAPER,
    SIDE_COLORS,
    draw_disc,
    draw_line,
    draw_text,
)
from humansim_ros.keypoints import KEYPOINT_SETS, KeypointSet  # noqa: E402
from humansim_ros.scene import Frame  # noqa: E402
from humansim_ros.truth import VISIBLE  # noqa: E402
from humansim_ros.types import Image  # noqa: E402

_SIZE = (520, 620)
#: Seconds of the motion t_to_a_pose at which the arms are 45 degrees down.
_A_POSE = 2.0
_CAMERAS = {"front": (7.6, 2.6, 1.2), "back": (-7.6, 2.6, 1.2)}
_CHANNELS = ("rgb", "depth", "instance", "part")


def simulate() -> Frame:
    """A man in the A pose, from the front and from behind."""
    cameras = {
        name: {"size": list(_SIZE), "position": list(position), "look_at": [0, 0, 0.92], "fov_deg": 11.5}
        for name, position in _CAMERAS.items()
    }
    scene = Scene.from_dict(
        {
            "room": None,
            "world": {"background": list(PAPER)},
            "light": {"shadows": "none"},
            "humans": {"man": {"body": "adult_man", "motion": "t_to_a_pose"}},
            "cameras": cameras,
        }
    )
    with Simulation(scene, channels=_CHANNELS) as simulation:
        return simulation.frame(round(_A_POSE * scene.config.rate))


def side(point: str) -> int:
    """Side of an anatomical point: 1 left, -1 right, 0 middle."""
    return 1 if point.startswith("left_") else -1 if point.startswith("right_") else side_of(point)


def draw(frame: Frame, keypoints: KeypointSet, camera: str) -> Image:
    """One panel: visible keypoints are discs, others are rings."""
    rgb = frame.views[camera].rgb
    image = np.asarray(255 - (255 - rgb) * 0.5, dtype=np.uint8)
    view = frame.keypoints[keypoints.name][camera]["man"]
    sides = [side(point) for point in keypoints.points]
    for first, second in keypoints.edges:
        color = SIDE_COLORS[sides[first] if sides[first] == sides[second] else 0]
        draw_line(image, [view.pixels[first], view.pixels[second]], color, 2)
    for pixel, state, which in zip(view.pixels, view.visible, sides, strict=True):
        draw_disc(image, pixel, 5, SIDE_COLORS[which])
        if state != VISIBLE:
            draw_disc(image, pixel, 3, PAPER)
    title = keypoints.name + (" (from behind)" if camera == "back" else "")
    draw_text(image, title, (14, 26), 0.6, INK)
    return image


def main(path: str) -> None:
    """Write the sheet."""
    frame = simulate()
    panels = [draw(frame, keypoints, "front") for keypoints in KEYPOINT_SETS.values()]
    panels.append(draw(frame, KEYPOINT_SETS["plug_in_gait"], "back"))
    rows = [np.concatenate(panels[start : start + 3], axis=1) for start in range(0, len(panels), 3)]
    sheet = np.concatenate(rows)
    cv2.imwrite(path, sheet[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(sys.argv[1])
