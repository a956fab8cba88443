"""Summary of a motion file."""

from __future__ import annotations

import warnings
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.errors import HumansimWarning, MotionError
from humansim_ros.geometry import quaternion_to_matrix
from humansim_ros.motion.body.kinematics import JointPoses, Motion
from humansim_ros.motion.body.skeleton import Skeleton, hanim_skeleton
from humansim_ros.motion.files.bvh import PositionChannels
from humansim_ros.motion.files.files import read_motion
from humansim_ros.motion.matching.by_name import spread_frames
from humansim_ros.motion.matching.file_frame import axis_vector
from humansim_ros.motion.matching.joint_tables import JointMatch
from humansim_ros.motion.pose.contacts import find_stances, slide_distances
from humansim_ros.motion.pose.limits import load_limits
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.motion.pose.world_motion import (
    WorldMotion,
    floor_height,
    playing_warnings,
    posture_warnings,
    to_world,
)
from humansim_ros.types import Array

#: Bounds, floor and heading are measured in at most this number of frames, spread over the motion.
_MAX_SAMPLES = 2000
#: Feet and limits are checked in at most this number of frames, from the first on.
_MAX_CHECKED = 4000
#: Headings have a common direction if the length of their mean is at least this value.
_MIN_MEAN_HEADING = 0.3
#: Keys of a summary that are None if the file has no person. ``penetration`` always is.
_OF_PERSON = (
    *("table", "found_by", "confidence", "missing_bones", "roles", "up", "facing", "rest", "unit"),
    *("unit_name", "stature", "floor", "root_scale", "speed", "travel", "heading_deg", "jumps"),
    *("checked_frames", "stances", "slide", "limits", "penetration"),
)


def read_with_warnings(path: Path, positions: PositionChannels = "auto") -> tuple[Motion, tuple[str, ...]]:
    """Read a motion file. Returns the motion and the warnings of its reader."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = read_motion(path, positions)
    return motion, tuple(str(w.message) for w in caught if issubclass(w.category, HumansimWarning))


def describe_motion(
    motion: Motion,
    reader_warnings: tuple[str, ...] = (),
    table: str | None = None,
    unit: float | None = None,
    up: str | None = None,
    facing: str | None = None,
    min_confidence: float | None = None,
) -> dict[str, Any]:
    """Summarise a motion as JSON types. If it has no person, only the file is described.

    Keys of the file: ``joints`` (without ``end_sites``); ``channel_layouts``: channels in their order, such
    as ``Zrotation Xrotation Yrotation`` -> number of joints; ``positions``: whether position channels replace
    the OFFSET or are added to it; ``position_joints``: joints that have position channels; ``bounds``: lowest
    and highest joint position in file units and axes; ``warnings`` of the reader and of the checks.

    Keys of the person, None if ``unknown`` has the reason why there is none: ``confidence``: of the joint
    match or of the up axis, the lower of the two; ``up``, ``facing``: file axes; ``rest``: rest pose from
    which the axes are detected; ``unit``, ``stature``: metres; ``floor``: height of the floor on the up axis,
    file units; ``root_scale``: scale of the root's movement onto the general skeleton; ``speed``: mean speed
    over the floor, m/s; ``travel``: x and y from the first frame to the last; ``heading_deg``: mean heading,
    None if there is no common heading. ``travel`` and ``heading_deg`` are relative to the rest pose facing
    +x, with y to its left. ``jumps``: frame to which the person jumps, and distance in metres. From the first
    ``checked_frames`` frames: ``stances``; ``slide``: mean slide of a standing foot, mm; ``limits``:
    violations of joint limits. ``penetration`` is None; 0.4.0 removes it.

    Args:
        motion: The motion.
        reader_warnings: Warnings of its reader.
        table, unit, up, facing, min_confidence: The same as in :func:`to_world`.

    Raises:
        MotionError: A given value does not fit the motion.
    """
    summary, found = dict.fromkeys(_OF_PERSON), list(reader_warnings)
    unknown = None
    try:
        world = to_world(motion, table, unit, up, facing, min_confidence)
    except MotionError as error:
        if any(given is not None for given in (table, unit, up, facing, min_confidence)):
            raise  # a given value may be the cause
        unknown = error.message
    else:
        summary, checks = _person_summary(world, hanim_skeleton())
        found += [f"{motion.path}: {text}" for text in checks]
    return {**_file_summary(motion), **summary, "unknown": unknown, "warnings": found}


def headings(match: JointMatch, poses: JointPoses) -> Array:
    """Headings (N, 2) of the hips: x and y in ``map``. Their length is 1 for upright hips, and smaller for
    tilted hips."""
    hips = quaternion_to_matrix(poses.rotations[:, match.roles["Hips"]])
    return np.asarray(hips[:, :2, 0])


def mean_heading(match: JointMatch, poses: JointPoses) -> float | None:
    """Direction of the mean of :func:`headings`, radians in ``map``. None without a common direction."""
    x, y = headings(match, poses).mean(0)
    return float(np.arctan2(y, x)) if np.hypot(x, y) > _MIN_MEAN_HEADING else None


def _file_summary(motion: Motion) -> dict[str, Any]:
    points = motion.world_positions(spread_frames(motion, _MAX_SAMPLES))
    joints = list(zip(motion.joint_names, motion.channels, strict=True))
    layouts = [" ".join(channels) for name, channels in joints if channels or not name.endswith("_end")]
    return {
        "path": motion.path,
        "frames": motion.n_frames,
        "frame_time": motion.frame_time,
        "rate": 1 / motion.frame_time,
        "seconds": motion.duration,
        "joints": len(layouts),
        "end_sites": motion.n_joints - len(layouts),
        "roots": [motion.joint_names[j] for j in np.flatnonzero(motion.parents < 0)],
        "channels": motion.values.shape[1],
        "channel_layouts": dict(Counter(layout or "none" for layout in layouts)),
        "positions": motion.positions,
        "position_joints": [name for name, channels in joints if "position" in " ".join(channels)],
        "bounds": [points.min((0, 1)).tolist(), points.max((0, 1)).tolist()],
    }


def _person_summary(world: WorldMotion, skeleton: Skeleton) -> tuple[dict[str, Any], list[str]]:
    """Return the keys of a summary about the person, and warnings."""
    motion, match, frame = world.motion, world.match, world.frame
    retargeter = Retargeter.fit(world, skeleton)
    samples = spread_frames(motion, _MAX_SAMPLES)
    poses = world.sample(samples * motion.frame_time)
    hips = poses.positions[:, match.roles["Hips"], :2]
    steps = np.linalg.norm(np.diff(hips, axis=0), axis=-1)
    # leave out steps between samples that contain a jump
    steps[np.searchsorted(samples, [jump.frame for jump in world.jumps]) - 1] = 0.0
    first, last = np.searchsorted(samples, world.steady_frames[[0, -1]])
    heading = mean_heading(match, poses)
    # feet and joint limits
    times = world.frame_times[:_MAX_CHECKED]
    checked = world.sample(times)
    posed = retargeter.pose(checked)
    stances = find_stances(skeleton, posed, times)
    summary = dict.fromkeys(_OF_PERSON) | {
        "table": match.table,
        "found_by": match.by,
        "confidence": min(match.confidence, frame.confidence),
        "missing_bones": list(match.missing),
        "roles": {role: motion.joint_names[joint] for role, joint in match.roles.items()},
        "up": frame.up,
        "facing": frame.facing,
        "rest": "OFFSETs" if frame.offsets_stand else "straightest frame",
        "unit": frame.unit,
        "unit_name": frame.unit_name,
        "stature": frame.stature,
        "floor": _floor(world),
        "root_scale": retargeter.scale,
        "speed": float(steps.sum() / motion.duration) if motion.duration > 0 else 0.0,
        "travel": (hips[last] - hips[first]).tolist(),
        "heading_deg": None if heading is None else float(np.degrees(heading)),
        "jumps": [asdict(jump) for jump in world.jumps],
        "checked_frames": len(times),
        "stances": len(stances),
        "slide": float(slide_distances(skeleton, posed, stances).mean() * 1e3) if stances else 0.0,
        "limits": [asdict(violation) for violation in load_limits().report(retargeter.apply(checked)[0])],
    }
    return summary, [*playing_warnings(world), *posture_warnings(world, poses)]


def _floor(world: WorldMotion) -> float:
    """Height of the floor on the up axis of the file, file units."""
    upward = axis_vector(world.frame.up)
    steady = world.steady_frames
    spread = np.unique(np.linspace(0, len(steady) - 1, _MAX_SAMPLES).astype(np.intp))
    points = world.motion.world_positions(steady[spread])
    return floor_height((points @ upward).min(-1)) * float(upward.sum())
