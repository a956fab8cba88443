"""Measure the retargeting of motion files to the general skeleton, as a Markdown table (docs/motion.md).

    python tools/figures/motion_figures.py FOLDER

Directions: largest angle between a limb bone and its link. Twist: largest difference, about the bone,
between the rotation of the joint since the first frame and that of the bone. Body lines: median angle
between the lines of the body and those of the file (hips, shoulders, middle of the hips to middle of the
shoulders, thighs); the largest of the five. Bend axes: mean angle, over elbows and knees, between the
actual bend axis and that of the skeleton, in the modes ``thesis`` and ``full``. Slide: mean distance that
the sole slides in a stance, as retargeted and with pinned feet. Lowest: 1st and 50th percentile of the
lowest point of the feet. Height: 95th percentile of the top of the head above the floor.
"""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.errors import HumansimError
from humansim_ros.geometry import WORLD_FROM_BODY, angle_between
from humansim_ros.motion import hanim_skeleton, read_bvh
from humansim_ros.motion.body.skeleton import sole_heights
from humansim_ros.motion.matching.by_shape import match_motion
from humansim_ros.motion.matching.file_frame import BodyLines, detect_file_frame
from humansim_ros.motion.pose.contacts import FootContacts, find_stances, slide_distances
from humansim_ros.motion.pose.retarget import Retargeter, RetargetMode
from humansim_ros.motion.pose.world_motion import WorldMotion
from humansim_ros.types import Array

SKELETON = hanim_skeleton()
LIMBS = [f"{side}_{part}" for side in "lr" for part in ("shoulder", "elbow", "hip", "knee")]
HINGES = (
    ("l_shoulder", "l_elbow", (0, 0, -1)),
    ("r_shoulder", "r_elbow", (0, 0, 1)),
    ("l_hip", "l_knee", (0, 1, 0)),
    ("r_hip", "r_knee", (0, 1, 0)),
)
HEADER = (
    "file",
    "joints found",
    "up, unit",
    "directions °",
    "twist °",
    "body lines °",
    "bend axes °, thesis / full",
    "slide mm, as is / pinned",
    "lowest mm",
    "height m",
)


def row(path: Path) -> list[str]:
    motion = read_bvh(path)
    match = match_motion(motion)
    world = WorldMotion(motion, match, detect_file_frame(motion, match), loop="none")
    times = world.frame_times[:3000]
    poses = world.sample(times)
    retargeters: dict[RetargetMode, Retargeter] = {
        mode: Retargeter.fit(world, SKELETON, mode) for mode in ("thesis", "full")
    }
    full = retargeters["full"]
    posed = {mode: retargeter.pose(poses) for mode, retargeter in retargeters.items()}
    stances = find_stances(SKELETON, posed["full"], times)
    pinned = full.pose(replace(world, correction=FootContacts.detect(world, full)).sample(times))
    before, after = (slide_distances(SKELETON, p, stances) * 1e3 for p in (posed["full"], pinned))
    lowest = np.percentile(sole_heights(SKELETON, posed["full"]).min(-1) * 1e3, [1, 50])
    top = posed["full"][:, SKELETON.bone("vt3")]
    head = top[:, 2, 3] + top[:, 2, 1] * SKELETON.lengths[SKELETON.bone("vt3")]
    axes = " / ".join(f"{bend_axes(p):.0f}" for p in posed.values())
    return [
        path.stem,
        f"{match.table}, {100 * match.confidence:.0f} %",
        f"{world.frame.up}, {world.frame.unit_name}",
        f"{directions(posed['full'], poses.positions, full):.4f}",
        f"{twist(posed['full'], poses.rotations, full):.2f}",
        f"{body_lines(posed['full'], poses.positions, full):.0f}",
        axes,
        f"{before.mean():.0f} / {after.mean():.1f} ({len(stances)})" if stances else "no stance",
        f"{lowest[0]:.0f}, {lowest[1]:.0f}",
        f"{np.percentile(head, 95):.2f}",
    ]


def directions(posed: Array, positions: Array, retargeter: Retargeter) -> float:
    """Largest angle between limb bones and their links, degrees."""
    worst = 0.0
    for bone in LIMBS:
        start, end = retargeter.match.parallel[bone]
        link = positions[:, end] - positions[:, start]
        link /= np.maximum(np.linalg.norm(link, axis=-1, keepdims=True), 1e-12)
        across = np.linalg.norm(np.cross(posed[:, SKELETON.bone(bone), :3, 1], link), axis=-1)
        worst = max(worst, float(np.degrees(np.arcsin(np.clip(across, 0, 1))).max()))
    return worst


def twist(posed: Array, rotations: Array, retargeter: Retargeter) -> float:
    """Largest difference about the bone between rotations of joint and bone since frame 0, degrees."""
    worst = 0.0
    for bone in LIMBS:
        joint = Rotation.from_quat(rotations[:, retargeter.match.parallel[bone][0]])
        ours = Rotation.from_matrix(posed[:, SKELETON.bone(bone), :3, :3])
        expected = joint * joint[0].inv() * ours[0]
        about = (expected.inv() * ours).as_rotvec(degrees=True)[:, 1]
        worst = max(worst, float(np.abs(about).max()))
    return worst


def body_lines(posed: Array, positions: Array, retargeter: Retargeter) -> float:
    """Largest of the median angles between the lines of the body and those of the file, degrees."""
    ours, theirs = BodyLines.of_body(posed, SKELETON), BodyLines.of(positions, retargeter.match.roles)
    pairs = [(ours.hips, theirs.hips), (ours.shoulders, theirs.shoulders), (ours.trunk, theirs.trunk)]
    pairs += zip(ours.thighs, theirs.thighs, strict=True)
    return max(float(np.degrees(np.median(angle_between(a, b)))) for a, b in pairs)


def bend_axes(posed: Array) -> float:
    """Mean angle between bend axes of elbows and knees and those of the skeleton at rest, degrees."""
    angles = []
    for upper, lower, axis in HINGES:
        bone = SKELETON.bone(upper)
        frame = posed[:, bone, :3, :3]
        bend = np.cross(frame[..., 1], posed[:, SKELETON.bone(lower), :3, 1])
        seen = np.einsum("nji,nj->i", frame, bend)
        own = (WORLD_FROM_BODY @ SKELETON.rest[bone, :3, :3]).T @ axis
        turn = np.degrees(np.arctan2(seen[0], seen[2]) - np.arctan2(own[0], own[2]))
        angles.append(abs((turn + 180) % 360 - 180))
    return float(np.mean(angles))


def main() -> int:
    warnings.simplefilter("ignore")
    print("| " + " | ".join(HEADER) + " |\n|" + "---|" * len(HEADER))
    for path in sorted(Path(sys.argv[1]).glob("*.bvh")):
        try:
            cells = row(path)
        except HumansimError as error:
            cells = [path.stem, f"none: {error.message[:60]}"] + [""] * (len(HEADER) - 2)
        print("| " + " | ".join(cells) + " |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
