"""Accuracy and time of fitting a human to photographs.

    python benchmarks/fit.py [--seeds 3] [--frames 100] [--silhouettes]

People other than the one that the fit starts from walk, run and wave before calibrated cameras: those of the
Shelf data set where it is there, a ring of four otherwise. Points have 2 px of noise, and 10 % of them are
anywhere near the person. Errors are distances of all joints of the skeleton from the truth in millimetres, of
hands and feet too, which no point of coco17 shows. Then a sequence is fitted; its jitter is the median
second difference of the errors of the joints, and its motion goes through BVH into a scene and is compared
with the fit.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "test")]

from photographs.studio import Studio, make_studio  # noqa: E402

from humansim_ros.errors import HumansimWarning  # noqa: E402
from humansim_ros.humans.human import write_human  # noqa: E402
from humansim_ros.motion import write_bvh  # noqa: E402
from humansim_ros.photographs import read_views  # noqa: E402
from humansim_ros.photographs.fitting import fit_person  # noqa: E402
from humansim_ros.photographs.person_fit import PersonFit, fit_motion  # noqa: E402
from humansim_ros.scene import Scene  # noqa: E402

#: Human, motion, first frame, keypoints, cameras.
CASES: tuple[tuple[str, str, int, str, int | str], ...] = (
    ("adult_woman", "walk", 7, "coco17", "shelf"),
    ("adult_woman", "walk", 7, "halpe26", "shelf"),
    ("child", "wave", 20, "coco17", "shelf"),
    ("tall_heavy_man", "run", 5, "coco17", "shelf"),
    ("tall_heavy_man", "run", 5, "body25", "shelf"),
    ("adult_woman", "walk", 7, "coco17", 4),
    ("tall_heavy_man", "wave", 30, "coco17", 8),
)
NOISE = {"noise": 2.0, "outliers": 0.1}
HEAD = f"{'':44} {'mean':>6} {'median':>6} {'worst':>6} {'IoU':>6} {'s':>6}"


def fitted(studio: Studio, silhouettes: bool) -> tuple[PersonFit, float]:
    """Fit, and seconds."""
    photos = read_views(studio.path)
    start = time.perf_counter()
    return fit_person(photos, silhouettes=silhouettes), time.perf_counter() - start


def joints(fit: PersonFit) -> NDArray[np.float64]:
    """(F, J, 3) metres."""
    return np.array([fit.joints(number) for number in range(len(fit.root))])


def row(name: str, errors: NDArray[np.float64], iou: float, seconds: float) -> str:
    """Line of the table; errors in metres."""
    own = 1000 * errors
    return f"{name:44} {own.mean():6.1f} {np.median(own):6.1f} {own.max():6.1f} {iou:6.3f} {seconds:6.1f}"


def least_iou(fit: PersonFit, studio: Studio, silhouettes: bool) -> float:
    """Mean overlap of the silhouettes of the first frame; NaN without silhouettes."""
    if not silhouettes:
        return float("nan")
    from humansim_ros.photographs.silhouettes import silhouette_iou

    return float(np.mean(list(silhouette_iou(fit, read_views(studio.path), 0).values())))


def single(folder: Path, seeds: int, silhouettes: bool) -> None:
    """One frame of several people."""
    print("One frame: joint errors in mm, mean IoU of the views, seconds\n" + HEAD)
    for human, motion, begin, keypoints, cameras in CASES:
        errors, overlaps, times = [], [], []
        for seed in range(seeds):
            options: dict[str, Any] = {"begin": begin + 3 * seed, "seed": seed, "images": False, **NOISE}
            place = folder / f"{human}_{motion}_{keypoints}_{cameras}_{seed}"
            studio = make_studio(place, human, motion, cameras, keypoints=keypoints, **options)
            fit, seconds = fitted(studio, silhouettes)
            errors.append(np.linalg.norm(joints(fit) - studio.joints, axis=-1))
            overlaps.append(least_iou(fit, studio, silhouettes))
            times.append(seconds)
        name = f"{human} {motion}, {keypoints}, {cameras} cameras"
        print(row(name, np.array(errors), float(np.mean(overlaps)), float(np.median(times))))


def sequence(folder: Path, frames: int, silhouettes: bool) -> None:
    """Many frames of one person with four cameras, and their way back into a scene."""
    print(f"\n{frames} frames, four cameras: joint errors in mm, IoU of the first frame, seconds\n" + HEAD)
    for human, motion, keypoints in (
        ("child", "wave", "coco17"),
        ("adult_woman", "turn_in_place", "halpe26"),
    ):
        place = folder / f"{human}_{motion}_sequence"
        studio = make_studio(
            place, human, motion, 4, frames=frames, keypoints=keypoints, images=False, **NOISE
        )
        fit, seconds = fitted(studio, silhouettes)
        found = joints(fit)
        errors = np.linalg.norm(found - studio.joints, axis=-1)
        print(row(f"{human} {motion}, {keypoints}", errors, least_iou(fit, studio, silhouettes), seconds))
        jitter = np.linalg.norm(np.diff(found - studio.joints, 2, axis=0), axis=-1)
        print(f"    jitter {1000 * np.median(jitter):.2f} mm", end="")
        write_bvh(place / "fit.bvh", fit_motion(fit))
        write_human(place / "person.npz", fit.body)
        scene = Scene.from_dict(
            {
                "rate": 25,
                "room": None,
                "humans": {"a": {"body": "person.npz", "motion": {"file": "fit.bvh", "anchor": "file"}}},
                "cameras": {"c": {"position": [3, 0, 1], "look_at": [0, 0, 1]}},
            },
            place,
        )
        played = np.array([scene.actors["a"].at(number / 25).positions for number in range(frames - 1)])
        apart = np.linalg.norm(played - found[: frames - 1], axis=-1)
        print(f"; played back from BVH within {1000 * apart.max():.1f} mm")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--silhouettes", action="store_true", help="fit to the masks, too")
    options = parser.parse_args()
    warnings.simplefilter("ignore", HumansimWarning)
    with tempfile.TemporaryDirectory() as folder:
        single(Path(folder), options.seeds, options.silhouettes)
        sequence(Path(folder), options.frames, options.silhouettes)


if __name__ == "__main__":
    main()
