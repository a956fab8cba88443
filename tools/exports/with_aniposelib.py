"""Triangulate the keypoints of an export with aniposelib and its calibration, and compare with the truth.

    ANIPOSE_PYTHON tools/exports/with_aniposelib.py FOLDER

Run it with a Python that has aniposelib; ``tools/exports/make.py`` makes the folder.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from aniposelib.cameras import CameraGroup


def compare(folder: Path) -> None:
    """Distances of the keypoints that two cameras or more have in the image, of all people in all frames."""
    truth = np.load(folder / "truth.npz")
    cameras = CameraGroup.load(str(folder / "export" / "anipose" / "calibration.toml"))
    pose = folder / "export" / "openpose" / "pose"
    files = [sorted((pose / f"{name}_json").glob("*.json")) for name in cameras.get_names()]
    for number, person in enumerate(truth["people"].tolist()):
        rows = [
            [json.loads(file.read_text())["people"][number]["pose_keypoints_2d"] for file in of_camera]
            for of_camera in files
        ]
        rows = np.array(rows, dtype=float).reshape(len(rows), len(rows[0]), -1, 3)
        rows[rows[..., 2] == 0] = np.nan
        expected = truth[f"{person}_keypoints"]
        found = cameras.triangulate(rows[..., :2].reshape(len(rows), -1, 2)).reshape(expected.shape)
        distance = np.linalg.norm(found - expected, axis=-1)
        known = np.isfinite(distance)
        print(
            f"aniposelib {person}: {known.sum()} of {known.size} keypoints: "
            f"mean {distance[known].mean():.1e} m, at most {distance[known].max():.1e} m"
        )


if __name__ == "__main__":
    compare(Path(sys.argv[1]))
