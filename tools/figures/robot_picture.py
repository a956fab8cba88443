"""Write docs/images/robot.jpg: a robot among people at three times, from a camera of it and from the room.

python tools/figures/robot_picture.py OUTPUT
"""

from __future__ import annotations

import sys

import cv2

from humansim_ros.files.reading.assets import resource_path
from humansim_ros.scene import Needs, Scene, Simulation

#: Frames that are shown.
_FRAMES = (25, 70, 150)


def main(output: str) -> None:
    scene = Scene.load(resource_path("config/scenes/robot.yaml"))
    needs = Needs(("rgb",), ("left", "room"))
    with Simulation(scene) as simulation:
        frames = [simulation.frame(index, needs) for index in _FRAMES]
    rows = [cv2.hconcat([frame.views[name].rgb for frame in frames]) for name in ("left", "room")]
    picture = cv2.resize(cv2.vconcat(rows), None, fx=0.625, fy=0.625, interpolation=cv2.INTER_AREA)
    cv2.imwrite(output, picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main(sys.argv[1])
