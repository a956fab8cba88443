"""Render people through the cameras of a calibration file, and compare projected and rendered outlines.

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
        # the projected vertices enclose the same pixels as the rendered mask
        pixels, _ = camera.project(frame.humans["anna"].vertices)
        rows, columns = np.nonzero(frame.views[name].instance)
        rendered = [columns.min(), rows.min(), columns.max(), rows.max()] if len(rows) else [np.nan] * 4
        error = np.abs(np.concatenate([pixels.min(axis=0), pixels.max(axis=0)]) - rendered).max()
        visible = (frame.joints[name]["anna"].visible == 2).sum()
        print(f"{name}: {visible} joints visible; projected and rendered outline differ by {error:.2f} px")


if __name__ == "__main__":
    main()
