"""Shares of rings whose extrinsics are read in the wrong direction, and of those that are doubtful.

    python benchmarks/conventions.py [--rings 2000] [--seed 1]

Each random ring has 3 to 12 cameras at 2.5 to 4.5 m from a person and 1 to 2.5 m above the floor, whose
optical axes pass the person within 5 or 30 cm. A file has the K of the cameras and their ``extrinsics``,
either from the world to the camera or from the camera to the world, in a world with z up, with y down, or
with the axes of the first camera. Printed are the shares of rings that are read wrong, that are read wrong
although the warning is not doubtful, and that are doubtful.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parent.parent))

from humansim_ros.cameras import read_calibration

Matrix = NDArray[np.float64]
#: Axes of the world of a file in a world with z up; those of the first camera if None.
WORLDS: dict[str, Matrix | None] = {
    "z up": np.eye(3),
    "y down": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "first camera": None,
}
MISSES = (0.05, 0.3)
K = [[900.0, 0, 639.5], [0, 900.0, 359.5], [0, 0, 1]]


def random_ring(rng: np.random.Generator, miss: float, axes: Matrix | None) -> Matrix:
    """Poses (N, 4, 4) from the world of a file to the cameras of a random ring.

    ``miss``: largest distance of the optical axes from the point at which the cameras look, metres.
    """
    count = int(rng.integers(3, 13))
    angles = rng.uniform(0, 2 * np.pi, count)
    radii, heights = rng.uniform(2.5, 4.5, count), rng.uniform(1, 2.5, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, angle, radius, height in zip(poses, angles, radii, heights, strict=True):
        center = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        offset = rng.normal(size=3)
        target = np.array([0, 0, 1]) + miss * rng.random() ** (1 / 3) * offset / np.linalg.norm(offset)
        forward = (target - center) / np.linalg.norm(target - center)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        pose[:3, :3] = right, np.cross(forward, right), forward
        pose[:3, 3] = -pose[:3, :3] @ center
    world = np.eye(4)
    if axes is None:
        world = np.linalg.inv(poses[0])
    else:
        world[:3, :3] = axes.T
    return np.asarray(poses @ world)


def verdict(poses: Matrix, inverse: bool, path: Path) -> tuple[bool, bool]:
    """Whether a file with these poses, or their inverses, is read wrong, and whether the warning is doubtful.

    Raises:
        ValueError: No warning says how to state the convention.
    """
    written = np.linalg.inv(poses) if inverse else poses
    cameras = [{"K": K, "size": [1280, 720], "extrinsics": pose.tolist()} for pose in written]
    path.write_text(json.dumps({"unit": "m", "cameras": cameras}))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read = list(read_calibration(path).values())
    said = " ".join(str(warning.message) for warning in caught)
    if 'to state it, add "convention": "' not in said:
        raise ValueError(f"no warning says how to state the convention: {said}")
    wrong = any(np.abs(c.R - p[:3, :3]).max() > 1e-6 for c, p in zip(read, poses, strict=True))
    return wrong, "but perhaps" in said


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rings", type=int, default=2000, help="of each row (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    print(f"{'axes of the world':<18} {'miss':>6} {'wrong':>8} {'unsaid':>8} {'doubtful':>9}")
    with tempfile.TemporaryDirectory() as folder:
        for name, axes in WORLDS.items():
            for miss in MISSES:
                found = np.array(
                    [
                        verdict(random_ring(rng, miss, axes), bool(number % 2), Path(folder) / "rig.json")
                        for number in range(options.rings)
                    ]
                )
                wrong, doubtful = found.T
                shares = wrong.mean(), (wrong & ~doubtful).mean(), doubtful.mean()
                print(f"{name:<18} {miss:4.2f} m {shares[0]:8.2%} {shares[1]:8.2%} {shares[2]:9.2%}")


if __name__ == "__main__":
    main()
