"""Draw moments of a scene with living faces (docs/images/faces_in_scenes.jpg).

python tools/figures/face_scene_picture.py OUT.jpg
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros.render.pictures import title_bar  # noqa: E402
from humansim_ros.scene import Scene, Simulation  # noqa: E402

SCENE = {
    "rate": 20,
    "room": None,
    "humans": {
        "anna": {
            "body": "adult_woman",
            "motion": {"file": "stand", "position": [0.0, 0.3]},
            "face": {
                "alive": True,
                "head": 1,
                "keys": [
                    {"gaze": "close"},
                    {"time": 1.0, "expression": "happiness", "strength": 0.8},
                    {"time": 2.0, "gaze": "ben", "expression": "neutral"},
                    {"time": 3.0, "speak": 3.0},
                    {"time": 6.5, "expression": "surprise", "gaze": [1.5, 0.9, 1.1]},
                ],
            },
        },
        "ben": {
            "body": "adult_man",
            "motion": {"file": "stand", "position": [0.0, -0.3], "offset": 9.0},
            "face": {
                "alive": True,
                "head": 1,
                "keys": [
                    {"gaze": "anna"},
                    {"time": 2.0, "gaze": "close", "speak": 2.5},
                    {"time": 5.0, "expression": "anger", "strength": 0.8},
                ],
            },
        },
    },
    "cameras": {
        "close": {
            "size": [420, 240],
            "position": [1.9, 0.0, 1.62],
            "look_at": [0.0, 0.0, 1.56],
            "fov_deg": 31,
        }
    },
}
TIMES = {"0.5 s": 0.5, "1.6 s": 1.6, "3.6 s": 3.6, "3.75 s": 3.75, "6.0 s": 6.0, "7.5 s": 7.5}


def main() -> None:
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    scene = Scene.from_dict(SCENE)
    tiles = []
    with Simulation(scene, ("rgb",)) as simulation:
        for title, seconds in TIMES.items():
            picture = simulation.frame(round(seconds * 20)).views["close"].rgb
            tiles.append(np.concatenate([title_bar(title, picture.shape[1]), picture]))
    rows = [np.concatenate(tiles[first : first + 3], axis=1) for first in (0, 3)]
    cv2.imwrite(sys.argv[1], np.concatenate(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 86])


if __name__ == "__main__":
    main()
