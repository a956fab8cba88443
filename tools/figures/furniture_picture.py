"""Draw the built-in meshes beside a person (docs/images/furniture.jpg).

python tools/figures/furniture_picture.py OUTPUT
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros import Scene, Simulation  # noqa: E402
from humansim_ros.render.pictures import INK, draw_text, text_size  # noqa: E402
from humansim_ros.scene.core.objects import FURNITURE, SHAPES  # noqa: E402

#: Positions from left to right as the camera sees them: y in metres.
_PLACES = {
    "doorway": 7.1,
    "door_leaf": 5.15,
    "door": 4.2,
    "screen": 2.6,
    "shelf": 1.2,
    "robot": 0.46,
    "table": -0.6,
    "chair": -2.0,
    "box": -3.0,
    "sphere": -3.75,
    "cylinder": -4.5,
    "cart": -5.7,
}


def main() -> int:
    if len(sys.argv) != 2:
        print(__doc__)
        return 2
    assert set(_PLACES) == {*FURNITURE, *SHAPES}
    objects = {}
    for name, y in _PLACES.items():
        shape = name in SHAPES
        objects[name] = {"mesh": name, "position": [0, y, 0.25 if shape else 0]}
        if shape:
            objects[name]["size"] = [0.5, 0.5, 0.5]
        else:
            objects[name]["rotation_deg"] = [0, 0, -20]
    scene = Scene.from_dict(
        {
            "room": None,
            "world": {"background": [238, 240, 243], "shadow_catcher": True},
            "light": {"shadows": "soft"},
            "humans": {"anna": {"body": "adult_woman", "motion": {"file": "wave", "position": [0.6, -1.35]}}},
            "objects": objects,
            "cameras": {
                "front": {
                    "size": [1280, 420],
                    "position": [11, 0.75, 2.8],
                    "look_at": [0, 0.75, 0.85],
                    "fov_deg": 66,
                }
            },
        }
    )
    with Simulation(scene, channels=("rgb",)) as simulation:
        frame = simulation.frame(60)
    image = frame.views["front"].rgb.copy()
    for name, y in _PLACES.items():
        pixel = frame.cameras["front"].project(np.array([[0.5, y, -0.12]]))[0][0]
        draw_text(
            image, name, (round(pixel[0]) - text_size(name, 0.5)[0] // 2, round(pixel[1]) + 14), 0.5, INK
        )
    cv2.imwrite(sys.argv[1], image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    return 0


if __name__ == "__main__":
    sys.exit(main())
