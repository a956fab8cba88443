"""Measure the built-in motions on the default human, as a Markdown table (docs/motions.md)."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from humansim_ros.humans.loading import load_human
from humansim_ros.motion.bvh import read_bvh
from humansim_ros.motion.info import to_world
from humansim_ros.motion.limits import load_limits
from humansim_ros.motion.penetration import fit_capsules, report_penetration
from humansim_ros.motion.retarget import Retargeter
from humansim_ros.motion.soles import find_stances, slide_distances, sole_heights

ROOT = Path(__file__).resolve().parents[2]


def main() -> int:
    human = load_human(ROOT / "assets" / "humans" / "adult_man.npz")
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
    for path in sorted((ROOT / "assets" / "motions").glob("*.bvh")):
        world = to_world(read_bvh(path))
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
            f"| {path.stem} | {way.mean():.0f} / {way.max():.0f} "
            f"| {1e3 * sole_heights(skeleton, posed).min():.0f} "
            f"| {', '.join(passed) or 'none'} | {depth:.0f} | {speed:.1f} |"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
