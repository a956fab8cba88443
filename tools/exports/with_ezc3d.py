"""Read the C3D files of an export with ezc3d, and the TRC files, and compare with the truth.

    python tools/exports/with_ezc3d.py FOLDER

``tools/exports/make.py`` makes the folder.
"""

from __future__ import annotations

import sys
from pathlib import Path

import ezc3d
import numpy as np


def compare(folder: Path) -> None:
    """Distances of all keypoints of all people in all frames."""
    truth = np.load(folder / "truth.npz")
    for person in truth["people"].tolist():
        expected = truth[f"{person}_keypoints"]
        c3d = ezc3d.c3d(str(folder / "export" / "c3d" / f"{person}.c3d"))
        in_c3d = c3d["data"]["points"][:3].transpose(2, 1, 0) / 1000
        rows = np.loadtxt(folder / "export" / "trc" / f"{person}.trc", delimiter="\t", skiprows=6)
        in_trc = rows[:, 2:].reshape(expected.shape)[..., [2, 0, 1]]
        for name, found in (("C3D", in_c3d), ("TRC", in_trc)):
            worst = np.linalg.norm(found - expected, axis=-1).max()
            print(f"{name} {person}: {len(found)} frames, {found.shape[1]} points: at most {worst:.1e} m")


if __name__ == "__main__":
    compare(Path(sys.argv[1]))
