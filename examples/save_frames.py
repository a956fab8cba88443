"""Write the images of all cameras of a scene as PNG files, and the joints of all humans as JSON.

python examples/save_frames.py SCENE.yaml FOLDER [COUNT]
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2

from humansim_ros import Scene, Simulation


def main() -> None:
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    folder = Path(sys.argv[2])
    folder.mkdir(parents=True, exist_ok=True)
    count = int(sys.argv[3]) if len(sys.argv) > 3 else 10
    with Simulation(Scene.load(sys.argv[1]), channels=("rgb",)) as simulation:
        for frame in simulation.frames(count):
            for camera, view in frame.views.items():
                # OpenCV writes BGR
                cv2.imwrite(str(folder / f"{camera}_{frame.index:04}.png"), view.rgb[..., ::-1])
            joints = {
                name: dict(zip(human.joint_names, human.positions.tolist(), strict=True))
                for name, human in frame.humans.items()
            }
            truth = {"stamp": frame.stamp, "joints": joints}
            (folder / f"joints_{frame.index:04}.json").write_text(json.dumps(truth))


if __name__ == "__main__":
    main()
