"""Render people through the cameras of a calibration file, and check the projection against the truth.

    python examples/own_calibration.py CALIBRATION

CALIBRATION: a file of any supported format (ROS camera_info, Kalibr, COLMAP, OpenCV, ...; docs/cameras.md).
"""

from __future__ import annotations

import sys

import numpy as np

from humansim_ros import Scene, Simulation, read_calibration


def main() -> None:
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    cameras = read_calibration(sys.argv[1])
    print(f"{len(cameras)} cameras:", ", ".join(f"{n} {c.size[0]}x{c.size[1]}" for n, c in cameras.items()))
    # people stand where the cameras look: at the point nearest to all optical axes, on the floor
    normals = [np.eye(3) - np.outer(c.R[2], c.R[2]) for c in cameras.values()]
    centers = [c.center for c in cameras.values()]
    target = np.linalg.lstsq(sum(normals), sum(n @ c for n, c in zip(normals, centers, strict=True)))[0]
    scene = Scene.build(
        humans={"anna": {"body": "adult_woman", "motion": {"file": "wave", "position": target[:2].tolist()}}},
        cameras=cameras,
        room=None,
    )
    with Simulation(scene, channels=("depth", "instance", "part")) as simulation:
        frame = simulation.frame(0)
    for name, camera in frame.cameras.items():
        pixels, _ = camera.project(frame.humans["anna"].positions)
        error = np.abs(pixels - frame.joints[name]["anna"].pixels).max()
        visible = (frame.joints[name]["anna"].visible == 2).sum()
        print(f"{name}: {visible} joints visible, projection and truth agree to {error:.1e} px")


if __name__ == "__main__":
    main()
