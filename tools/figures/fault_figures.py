"""Draw the faults of pictures and calibrations (docs/images/faults.jpg).

python tools/figures/fault_figures.py OUTPUT
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from humansim_ros.scene import Frame, Scene, Simulation
from humansim_ros.scene.pictures import views
from humansim_ros.types import Array, Image

_SIZE = (400, 300)
#: Number of the frame that is shown.
_SHOWN = 16
_CAMERA: dict[str, Any] = {
    "size": list(_SIZE),
    "position": [2.6, -2.3, 1.5],
    "look_at": [0.3, 0.1, 0.85],
    "fov_deg": 58,
}
#: Tiles: title, faults, sensor, and whose joints are drawn: none, of the truth, or as published.
_TILES: list[tuple[str, dict[str, Any], dict[str, Any], str]] = [
    ("without faults; true joints", {}, {}, "true"),
    ("trigger_delay 60 ms; true joints", {"trigger_delay": 0.06}, {}, "true"),
    (
        "calibration 2 deg, 4 cm, focal 0.03; joints as published",
        {"calibration": {"rotation": 2, "translation": 0.04, "focal": 0.03}, "seed": 2},
        {},
        "published",
    ),
    ("flicker 100 Hz, rolling shutter", {"flicker": {"frequency": 100}}, {"rolling_shutter": 1e-4}, ""),
    ("exposure_steps: -1.5 stops", {"exposure_steps": {"probability": 1, "stops": [-1.5, -1.5]}}, {}, ""),
    ("dirt: 12 spots", {"dirt": 12, "seed": 1}, {}, ""),
]


def frame_of(faults: dict[str, Any], sensor: dict[str, Any]) -> Frame:
    camera = {**_CAMERA, "sensor": sensor, **({"faults": faults} if faults else {})}
    human = {"motion": {"file": "run", "anchor": "center", "yaw_deg": 20}}
    scene = Scene.from_dict({"humans": {"one": human}, "cameras": {"left": camera}})
    with Simulation(scene, ("rgb", "depth", "instance", "part")) as simulation:
        return simulation.frame(_SHOWN)


def with_joints(picture: Image, frame: Frame, pixels: Array) -> Image:
    skeleton = frame.models["one"].skeleton
    parents = [None if p < 0 else skeleton.names[p] for p in skeleton.parents]
    parents += [skeleton.names[bone] for bone in skeleton.ends]
    visible = frame.joints["left"]["one"].visible
    return views.draw_joints(picture, pixels, visible, skeleton.joint_names, parents)


def tile(title: str, faults: dict[str, Any], sensor: dict[str, Any], joints: str) -> Image:
    frame = frame_of(faults, sensor)
    picture = frame.views["left"].rgb
    if joints:
        cameras = frame.published_cameras if joints == "published" else frame.cameras
        picture = with_joints(picture, frame, cameras["left"].project(frame.humans["one"].positions)[0])
    out = cv2.copyMakeBorder(picture, 26, 4, 4, 4, cv2.BORDER_CONSTANT, value=(28, 28, 28))
    cv2.putText(out, title, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (235, 235, 235), 1, cv2.LINE_AA)
    return np.asarray(out, dtype=np.uint8)


def main() -> int:
    if len(sys.argv) != 2:
        print(__doc__)
        return 2
    tiles = [tile(*each) for each in _TILES]
    rows = [np.concatenate(tiles[i : i + 3], axis=1) for i in range(0, len(tiles), 3)]
    cv2.imwrite(str(Path(sys.argv[1])), np.concatenate(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 80])
    return 0


if __name__ == "__main__":
    sys.exit(main())
