"""Draw the sheet of a scene with two people and three cameras (docs/images/snapshot.jpg).

python tools/figures/snapshot_picture.py OUTPUT
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros import Scene  # noqa: E402
from humansim_ros.scene.pictures.sheets import snapshot  # noqa: E402

_SCENE = {
    "humans": {
        "anna": {
            "body": "adult_woman",
            "motion": {"file": "walk", "position": [0.4, -1.4], "loop": "continue"},
        },
        "ben": {
            "body": "tall_heavy_man",
            "motion": {"file": "wave", "position": [-1.3, 0.9], "yaw_deg": -40},
        },
    },
    "objects": {"chair": {"mesh": "chair", "position": [0.4, 0.1, 0], "rotation_deg": [0, 0, -60]}},
    "cameras": {
        f"camera_{number}": {
            "size": [640, 480],
            "position": position,
            "look_at": [0, 0, 0.8],
            "fov_deg": 64,
        }
        for number, position in enumerate([[3.1, 2.8, 2.2], [-3.1, -2.8, 2.2], [3.1, -2.8, 2.2]], 1)
    },
}


def main() -> int:
    if len(sys.argv) != 2:
        print(__doc__)
        return 2
    image = snapshot(Scene.from_dict(_SCENE), seconds=1.0, width=1280)
    cv2.imwrite(sys.argv[1], image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    return 0


if __name__ == "__main__":
    sys.exit(main())
