"""Export a scene with all formats of motion capture, and its truth, for the other programs of this folder.

    python tools/exports/make.py FOLDER

Two people walk and wave in front of four cameras, one of which has lens distortion.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import yaml

from humansim_ros import Scene, Simulation

FRAMES = 60
SCENE = {
    "room": None,  # cameras are where its walls would be
    "humans": {
        "anna": {"body": "adult_woman", "motion": {"file": "walk"}},
        "ben": {"body": "child", "motion": {"file": "wave", "position": [0.5, 1.0], "yaw_deg": 40}},
    },
    "cameras": {
        f"camera_{number}": {"position": position, "look_at": [0.5, 0.3, 0.9], "fov_deg": 70, **lens}
        for number, position, lens in (
            (1, [4.0, 0.0, 1.5], {}),
            (2, [0.5, 4.5, 2.0], {"distortion": [-0.15, 0.05, 0.001, -0.001, 0.0]}),
            (3, [-3.5, 0.0, 1.8], {}),
            (10, [0.5, -4.0, 2.4], {}),
        )
    },
}
#: Formats, and the keypoint set of those that have a choice.
FORMATS, KEYPOINTS = "anipose,bvh,c3d,gazebo,glb,openpose,trc,usd", "coco17"


def write_truth(scene: Scene, path: Path) -> None:
    """Vertices, joints and keypoints of each person in each frame, in ``map``."""
    arrays = {"people": np.array(list(scene.actors)), "rate": np.array(scene.config.rate)}
    with Simulation(scene, channels=()) as simulation:
        frames = list(simulation.frames(FRAMES))
    for name, actor in scene.actors.items():
        states = [frame.humans[name] for frame in frames]
        arrays[f"{name}_bones"] = np.array(actor.human.skeleton.names)
        arrays[f"{name}_vertices"] = np.array([state.vertices for state in states])
        arrays[f"{name}_joints"] = np.array([state.positions for state in states])
        arrays[f"{name}_keypoints"] = np.array([f.keypoint_positions[KEYPOINTS][name] for f in frames])
    np.savez_compressed(path, **arrays)


def main(folder: Path) -> None:
    """Export the scene to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = folder / "scene.yaml"
    scene.write_text(yaml.safe_dump(SCENE))
    command = [sys.executable, "-m", "humansim_ros", "export", str(scene), "--frames", str(FRAMES)]
    options = ["-o", str(folder / "export"), "--format", FORMATS, "--keypoints", KEYPOINTS, "--jobs", "1"]
    subprocess.run([*command, *options], check=True)
    write_truth(Scene.load(scene), folder / "truth.npz")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
