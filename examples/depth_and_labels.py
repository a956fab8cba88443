"""Measure how far each human is from a camera, by its depth image and its instance labels.

python examples/depth_and_labels.py
"""

from __future__ import annotations

import numpy as np

from humansim_ros import Scene, Simulation


def main() -> None:
    scene = Scene.from_dict(
        {
            "humans": {
                "near": {"body": "child", "motion": {"file": "wave", "position": [1.0, 0.4]}},
                "far": {"body": "adult_man", "motion": {"file": "wave", "position": [-1.0, -0.4]}},
            },
            "cameras": {"eye": {"position": [3.3, 0, 1.4], "look_at": [0, 0, 1.0]}},
        }
    )
    with Simulation(scene, channels=("depth", "instance", "part", "amodal")) as simulation:
        frame = simulation.frame(0)
    view = frame.views["eye"]
    for name, label in frame.labels.items():
        mask = view.instance == label
        joints = frame.joints["eye"][name]
        box = frame.boxes["eye"][name]
        print(
            f"{name}: {mask.sum()} pixels, {np.median(view.depth[mask]):.2f} m away, "
            f"{box.visible_fraction:.0%} visible, {(joints.visible == 2).sum()} visible joints"
        )


if __name__ == "__main__":
    main()
