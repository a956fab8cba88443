"""Scene of the tests of adapters: two people before the cameras and one far away, a robot, and a scanner."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

SCENE: dict[str, Any] = {
    "rate": 20,
    "room": None,
    "humans": {
        "anna": {"body": "adult_woman", "motion": {"file": "walk", "position": [0, 0.6], "yaw_deg": 40}},
        "ben": {"body": "adult_man", "motion": {"file": "wave", "position": [0.3, -0.8]}},
        "away": {"body": "child", "motion": {"file": "walk", "position": [40, 0]}},
    },
    "robot": {"path": {"points": [[-2, 0], [2, 0.3], [2, 2]], "speed": 2}, "vibration": 0.002},
    "cameras": {
        "fixed": {"size": [96, 72], "position": [3.1, 2.8, 2.2], "look_at": [0, 0, 0.8], "fov_deg": 62},
        "ahead": {"size": [96, 72], "mount": "robot", "position": [0.1, 0, 1], "look_at": [1, 0, 0.9]},
    },
    "scanners": {"lidar": {"model": "velodyne_vlp16", "mount": "robot", "position": [0.2, 0, 0.4]}},
}


def write(folder: Path, adapters: dict[str, Any], **changes: Any) -> Path:
    """Write the scene with its section ``adapters``; ``changes``: other sections."""
    path = folder / "scene.yaml"
    path.write_text(json.dumps({**SCENE, **changes, "adapters": adapters}))
    return path
