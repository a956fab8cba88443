"""Accuracy and time of fitting a human to photographs.

    python benchmarks/fit.py [--seeds 3] [--frames 100] [--silhouettes]
    python benchmarks/fit.py --new-views PERSON [--new-views PERSON ...]

People other than the one that the fit starts from walk, run and wave before calibrated cameras: those of the
Shelf data set where it is there, a ring of four otherwise. Points have 2 px of noise, and 10 % of them are
anywhere near the person. Errors are distances of all joints of the skeleton from the truth in millimetres, of
hands and feet too, which no point of coco17 shows. Then a sequence is fitted; its jitter is the median
second difference of the errors of the joints, and its motion goes through BVH into a scene and is compared
with the fit.

``--new-views`` fits the built-in man to photographs of other people, textures him, and compares pictures from
new views with the truth: pixels of the person that some camera saw, with those that the fitted body covers
alone, and the least of the views.
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

from photographs.studio import Studio, make_studio, ring  # noqa: E402

from humansim_ros.errors import HumansimWarning  # noqa: E402
from humansim_ros.motion import write_bvh  # noqa: E402
from humansim_ros.people.humans.human import write_human  # noqa: E402
from humansim_ros.photographs import read_views  # noqa: E402
from humansim_ros.photographs.atlas_texture import texture_person  # noqa: E402
from humansim_ros.photographs.fitting import fit_person  # noqa: E402
from humansim_ros.photographs.person_fit import PersonFit, fit_motion  # noqa: E402
from humansim_ros.photographs.silhouettes import silhouette_iou  # noqa: E402
from humansim_ros.render import Body, GLRenderer, Lighting  # noqa: E402
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
#: Joints of the limbs, which skeletons of other authors have at the same places, without their side.
LIMBS = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
#: Motions and frames of new views, size of their images, and number of views.
POSES, SIZE, NEW = (("walk", 7), ("pick_up", 30)), (960, 720), 5
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
            errors.append(np.linalg.norm(joints(fit) - studio.body_joints, axis=-1))
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
        errors = np.linalg.norm(found - studio.body_joints, axis=-1)
        print(row(f"{human} {motion}, {keypoints}", errors, least_iou(fit, studio, silhouettes), seconds))
        jitter = np.linalg.norm(np.diff(found - studio.body_joints, 2, axis=0), axis=-1)
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


def psnr(errors: NDArray[np.float64]) -> float:
    """Peak signal to noise ratio of differences of colours, dB."""
    return float(10 * np.log10(255**2 / np.mean(errors**2)))


def new_views(folder: Path, person: str) -> None:
    """The textured fit of a person from views that were not used."""
    for motion, begin in POSES:
        options: dict[str, Any] = {"begin": begin, "human": person, "motion": motion}
        truth = make_studio(
            folder / f"{motion}_new", cameras=ring(NEW, SIZE, turn=0.31), jpeg=None, **options
        )
        photographs = read_views(truth.path).frames[0]
        own = Body(truth.human.mesh, truth.vertices[0], truth.human.triangle_parts, 1)
        for count in (4, 8):
            studio = make_studio(
                folder / f"{motion}_{count}", cameras=ring(count, SIZE), noise=2.0, **options
            )
            fit, seconds = fitted(studio, True)
            photos = read_views(studio.path)
            textured = texture_person(fit, photos).human
            shown = Body(textured.mesh, fit.vertices(), textured.triangle_parts, 1)
            seen = np.zeros(len(truth.human.mesh.triangles) + 1, bool)
            known, covered, views = [], [], []
            with GLRenderer(lighting=Lighting(mode="shadeless")) as renderer:
                for camera in studio.cameras.values():
                    seen[renderer.render([own], camera, ("face",)).face] = True
                seen[0] = False
                for photo, camera in zip(photographs, truth.cameras.values(), strict=True):
                    found = renderer.render([shown], camera, ("rgb", "face"))
                    face = renderer.render([own], camera, ("face",)).face
                    error = photo.image().astype(float) - found.rgb
                    known.append(error[seen[face]])
                    covered.append(error[seen[face] & (found.face > 0)])
                    views.append(psnr(known[-1]))
            bones = truth.human.skeleton.joint_names, fit.body.skeleton.joint_names
            both = [name for name in bones[1] if name in bones[0] and name[2:] in LIMBS]
            places = [[own.index(name) for name in both] for own in bones]
            apart = np.linalg.norm(truth.joints[0][places[0]] - fit.joints()[places[1]], axis=1)
            overlap = np.mean(list(silhouette_iou(fit, photos).values()))
            print(
                f"{Path(person).stem} {motion}, {count} cameras: {psnr(np.concatenate(known)):.1f} dB "
                f"(covered {psnr(np.concatenate(covered)):.1f}, least view {min(views):.1f}), overlap "
                f"{overlap:.3f}, limbs {1000 * apart.mean():.1f} mm, {seconds:.0f} s",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--silhouettes", action="store_true", help="fit to the masks, too")
    parser.add_argument(
        "--new-views", action="append", default=[], metavar="PERSON", help="compare new views of this human"
    )
    options = parser.parse_args()
    warnings.simplefilter("ignore", HumansimWarning)
    with tempfile.TemporaryDirectory() as folder:
        for person in options.new_views:
            new_views(Path(folder), person)
        if not options.new_views:
            single(Path(folder), options.seeds, options.silhouettes)
            sequence(Path(folder), options.frames, options.silhouettes)


if __name__ == "__main__":
    main()
