"""Measure the built-in motions on the default human, as a Markdown table (docs/motions.md).

    python tools/figures/library_figures.py
    python tools/figures/library_figures.py --picture docs/images/motions_everyday.jpg talk phone squats …

The picture shows phases of motions, one row each.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from capsules import fit_capsules, report_penetration

from humansim_ros.files.reading.assets import built_in_names
from humansim_ros.motion.body.skeleton import sole_heights
from humansim_ros.motion.files.files import read_motion
from humansim_ros.motion.pose.contacts import find_stances, slide_distances
from humansim_ros.motion.pose.limits import load_limits
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.motion.pose.world_motion import to_world
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.loading import load_human
from humansim_ros.render.pictures import draw_text
from humansim_ros.scene.pictures.people import SkinnedArtist

ROOT = Path(__file__).resolve().parents[2]


#: Phases of a motion in the picture, and width and height of one, pixels.
PHASES, SIZE = 12, (96, 130)


def main() -> int:
    parser = argparse.ArgumentParser(description="Measure or draw the built-in motions.")
    parser.add_argument("names", nargs="*", help="all if none is given")
    parser.add_argument("--picture", type=Path, help="draw the motions into this file instead")
    arguments = parser.parse_args()
    names = arguments.names or built_in_names("motions")
    human = load_human(ROOT / "assets" / "humans" / "adult_man.npz")
    if arguments.picture is not None:
        draw(human, names, arguments.picture)
    else:
        measure(human, names)
    return 0


def draw(human: Human, names: Sequence[str], picture: Path) -> None:
    """Draw phases of motions."""
    rows = []
    for name in names:
        artist = SkinnedArtist(human, to_world(read_motion(name)), SIZE)
        times = np.linspace(0, artist.figure.seconds, PHASES)
        images = np.concatenate([artist.draw(time) for time in times], axis=1)
        artist.close()
        draw_text(images, name, (4, 14), 0.4)
        rows.append(images)
    cv2.imwrite(str(picture), np.concatenate(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 82])


def measure(human: Human, names: Sequence[str]) -> None:
    """Print the table."""
    skeleton, limits = human.skeleton, load_limits().for_skeleton(human.skeleton)
    body = fit_capsules(human.skeleton, human.mesh, human.weights)
    heads = (
        "motion",
        "slide mm, mean / worst",
        "lowest sole mm",
        "limit violations",
        "penetration mm",
        "fastest m/s",
    )
    print("| " + " | ".join(heads) + " |")
    print("|---|---|---|---|---|---|")
    for name in names:
        world = to_world(read_motion(name))
        retargeter = Retargeter.fit(world, skeleton)
        times = world.frame_times
        poses = world.sample(times)
        posed = retargeter.pose(poses)
        way = slide_distances(skeleton, posed, find_stances(skeleton, posed, times)) * 1e3
        passed = [
            f"{v.bone} {v.angle} {v.worst:.0f} of {v.limit:.0f}"
            for v in limits.report(retargeter.apply(poses)[0])
        ]
        depth = max(0.0, report_penetration(posed, body).depth_mm)
        speed = np.linalg.norm(np.diff(posed[..., :3, 3], axis=0), axis=-1).max() / (times[1] - times[0])
        print(
            f"| {name} | {way.mean():.0f} / {way.max():.0f} "
            f"| {1e3 * sole_heights(skeleton, posed).min():.0f} "
            f"| {', '.join(passed) or 'none'} | {depth:.0f} | {speed:.1f} |"
        )


if __name__ == "__main__":
    sys.exit(main())
