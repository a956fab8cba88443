"""Triangulate the OpenPose files of an export with Pose2Sim, and compare with the truth.

    POSE2SIM_PYTHON tools/exports/with_pose2sim.py FOLDER

Run it with a Python that has pose2sim (``pip install pose2sim``); ``tools/exports/make.py`` makes the folder.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from anytree import PreOrderIter
from Pose2Sim import Pose2Sim, skeletons
from Pose2Sim.common import read_trc


def compare(folder: Path) -> None:
    """Distances of all keypoints of all people in all frames."""
    truth = np.load(folder / "truth.npz")
    project = folder / "export" / "openpose"
    Pose2Sim.Pose2SimPipeline(str(project / "Config.toml")).triangulation()
    numbers = {node.name: node.id for node in PreOrderIter(skeletons.COCO_17) if node.id is not None}
    for number, person in enumerate(truth["people"].tolist()):
        (file,) = (project / "pose-3d").glob(f"*_P{number}_*.trc")
        points, frames, _, names, _ = read_trc(file)
        # y up: (y, z, x) of map
        found = points.to_numpy(dtype=float).reshape(len(frames), len(names), 3)[..., [2, 0, 1]]
        expected = truth[f"{person}_keypoints"][frames.to_numpy(dtype=int)]
        expected = expected[:, [numbers[name] for name in names]]
        distance = np.linalg.norm(found - expected, axis=-1)
        print(
            f"Pose2Sim {person}: {distance.shape[0]} frames, {distance.shape[1]} keypoints: "
            f"mean {distance.mean():.1e} m, at most {distance.max():.1e} m"
        )


if __name__ == "__main__":
    compare(Path(sys.argv[1]).resolve())
