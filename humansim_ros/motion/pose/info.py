"""Summary of a motion file: contents, joints, units, axes, and how well the motion fits the general
skeleton."""

from __future__ import annotations

import warnings
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import HumansimWarning, MotionError
from humansim_ros.geometry import quaternion_to_matrix
from humansim_ros.motion.body.kinematics import JointPoses, Motion
from humansim_ros.motion.body.skeleton import Skeleton, hanim_skeleton
from humansim_ros.motion.files.bvh import PositionChannels
from humansim_ros.motion.files.files import read_motion
from humansim_ros.motion.matching.file_frame import axis_vector, detect_file_frame
from humansim_ros.motion.matching.joint_tables import JointMatch
from humansim_ros.motion.matching.person import match_motion
from humansim_ros.motion.motion.world_motion import (
    WorldMotion,
    floor_height,
    playing_warnings,
    posture_warnings,
)
from humansim_ros.motion.pose.limits import load_limits
from humansim_ros.motion.pose.penetration import fit_capsules, report_penetration
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.motion.pose.soles import find_stances, slide_distances
from humansim_ros.types import Array

#: Bounds, floor and heading are measured in at most this number of frames, spread over the motion.
_MAX_SAMPLES = 2000
#: Feet, limits and penetration are checked in at most this number of frames, from the first on.
_MAX_CHECKED = 4000
#: Headings have a common direction if the length of their mean is at least this value.
_MIN_MEAN_HEADING = 0.3


@dataclass(frozen=True)
class MotionInfo:
    """Summary of a motion file. If ``unknown`` is set, the values from ``table`` on are None, and it is the
    reason.

    File: ``joints`` (without ``end_sites``); ``channel_layouts``: channels in their order, such as
    ``Zrotation Xrotation Yrotation`` -> number of joints; ``positions``: whether position channels replace
    the OFFSET or are added to it; ``position_joints``: joints that have position channels; ``bounds``: lowest
    and highest joint position in file units and axes.

    Person: ``table``, ``found_by``, ``roles`` (role -> joint) and ``missing_bones`` of the joint match;
    ``confidence``: of the joint match or of the up axis, the lower of the two; ``up``, ``facing``: file axes;
    ``rest``: rest pose from which the axes are detected; ``unit``, ``stature``: metres; ``floor``: height of
    the floor on the up axis, file units; ``root_scale``: scale of the root's movement onto the general
    skeleton; ``speed``: mean speed over the floor, m/s; ``travel``: x and y from the first frame to the last;
    ``heading_deg``: mean heading, None if there is no common heading. ``travel`` and ``heading_deg`` are
    relative to the rest pose facing +x, with y to its left.

    ``jumps``: frame to which the person jumps, and distance in metres. ``warnings``: warnings of the reader
    and of the checks.

    From the first ``checked_frames`` frames: ``stances``; ``slide``: mean slide of a standing foot, mm;
    ``limits``: violations of joint limits; ``penetration``: the deepest self-penetration.
    """

    path: str
    frames: int
    frame_time: float
    rate: float
    seconds: float
    joints: int
    end_sites: int
    roots: list[str]
    channels: int
    channel_layouts: dict[str, int]
    positions: str
    position_joints: list[str]
    bounds: list[list[float]]
    table: str | None = None
    found_by: str | None = None
    confidence: float | None = None
    missing_bones: list[str] | None = None
    roles: dict[str, str] | None = None
    up: str | None = None
    facing: str | None = None
    rest: str | None = None
    unit: float | None = None
    unit_name: str | None = None
    stature: float | None = None
    floor: float | None = None
    root_scale: float | None = None
    speed: float | None = None
    travel: list[float] | None = None
    heading_deg: float | None = None
    jumps: list[dict[str, Any]] | None = None
    checked_frames: int | None = None
    stances: int | None = None
    slide: float | None = None
    limits: list[dict[str, Any]] | None = None
    penetration: dict[str, Any] | None = None
    unknown: str | None = None
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The summary as JSON types."""
        return {**asdict(self), "warnings": list(self.warnings)}


@dataclass(frozen=True)
class LoadedMotion:
    """A motion and the warnings of its reader."""

    motion: Motion
    warnings: tuple[str, ...]


def read_with_warnings(path: Path, positions: PositionChannels = "auto") -> LoadedMotion:
    """Read a motion file and collect the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = read_motion(path, positions)
    texts = [str(w.message) for w in caught if issubclass(w.category, HumansimWarning)]
    return LoadedMotion(motion, tuple(texts))


def to_world(
    motion: Motion,
    table: str | None = None,
    unit: float | None = None,
    up: str | None = None,
    facing: str | None = None,
    min_confidence: float | None = None,
    **options: Any,
) -> WorldMotion:
    """Place a motion in ``map``. Joints and file frame are detected where they are not given.

    Args:
        motion: Motion of a person.
        table: Joint table: name of a built-in table, or YAML file.
        unit: Metres per file unit.
        up: File axis that points up.
        facing: File axis that the person faces at rest.
        min_confidence: Lowest confidence of the joint match. If None, 0.12.
        options: Other fields of :class:`WorldMotion`. By default, ``loop`` is ``none``.

    Raises:
        MotionError: The motion is not that of a person, or a given value does not fit the motion.
    """
    match = match_motion(motion, table, min_confidence)
    frame = detect_file_frame(motion, match, unit, up, facing)
    return WorldMotion(motion, match, frame, **{"loop": "none", **options})


def describe_motion(
    loaded: LoadedMotion,
    table: str | None = None,
    unit: float | None = None,
    up: str | None = None,
    facing: str | None = None,
    min_confidence: float | None = None,
) -> MotionInfo:
    """Summarise a motion. If it has no person, only the file is described.

    Args:
        loaded: The motion and its warnings.
        table, unit, up, facing, min_confidence: The same as in :func:`to_world`.

    Raises:
        MotionError: A given value does not fit the motion.
    """
    for axis in (up, facing):
        if axis is not None:
            axis_vector(axis)
    try:
        world = to_world(loaded.motion, table, unit, up, facing, min_confidence)
    except MotionError as error:
        if table is not None or _is_person(loaded.motion):
            raise  # a given value is the cause
        return MotionInfo(**_file_summary(loaded), unknown=error.message)
    summary = _person_summary(world, hanim_skeleton())
    found = [f"{loaded.motion.path}: {text}" for text in summary.pop("warnings")]
    return MotionInfo(**{**_file_summary(loaded), "warnings": (*loaded.warnings, *found)}, **summary)


def headings(match: JointMatch, poses: JointPoses) -> Array:
    """Headings (N, 2) of the hips: x and y in ``map``. Their length is 1 for upright hips, and smaller for
    tilted hips."""
    hips = quaternion_to_matrix(poses.rotations[:, match.roles["Hips"]])
    return np.asarray(hips[:, :2, 0])


def mean_heading(match: JointMatch, poses: JointPoses) -> float | None:
    """Direction (radians in ``map``) of the mean of :func:`headings`. None if there is no common
    direction."""
    x, y = headings(match, poses).mean(0)
    return float(np.arctan2(y, x)) if np.hypot(x, y) > _MIN_MEAN_HEADING else None


def _is_person(motion: Motion) -> bool:
    try:
        to_world(motion)
    except MotionError:
        return False
    return True


def _sample_frames(frames: int) -> NDArray[np.intp]:
    """Frame numbers spread over a motion."""
    return np.unique(np.linspace(0, frames - 1, _MAX_SAMPLES).astype(np.intp))


def _file_summary(loaded: LoadedMotion) -> dict[str, Any]:
    motion = loaded.motion
    points = motion.world_positions(_sample_frames(motion.n_frames))
    ends = [
        j for j, name in enumerate(motion.joint_names) if name.endswith("_end") and not motion.channels[j]
    ]
    position_joints = [
        name
        for name, channels in zip(motion.joint_names, motion.channels, strict=True)
        if any(channel.endswith("position") for channel in channels)
    ]
    layouts = Counter(
        " ".join(channels) or "none" for j, channels in enumerate(motion.channels) if j not in ends
    )
    return {
        "path": motion.path,
        "frames": motion.n_frames,
        "frame_time": motion.frame_time,
        "rate": 1 / motion.frame_time,
        "seconds": motion.duration,
        "joints": motion.n_joints - len(ends),
        "end_sites": len(ends),
        "roots": [motion.joint_names[j] for j in np.flatnonzero(motion.parents < 0)],
        "channels": motion.values.shape[1],
        "channel_layouts": dict(layouts),
        "positions": motion.positions,
        "position_joints": position_joints,
        "bounds": [points.min((0, 1)).tolist(), points.max((0, 1)).tolist()],
        "warnings": loaded.warnings,
    }


def _person_summary(world: WorldMotion, skeleton: Skeleton) -> dict[str, Any]:
    motion, match, frame = world.motion, world.match, world.frame
    retargeter = Retargeter.fit(world, skeleton)
    samples = _sample_frames(motion.n_frames)
    poses = world.sample(samples * motion.frame_time)
    hips = poses.positions[:, match.roles["Hips"], :2]
    steps = np.linalg.norm(np.diff(hips, axis=0), axis=-1)
    # leave out steps between samples that contain a jump
    steps[np.searchsorted(samples, [jump.frame for jump in world.jumps]) - 1] = 0.0
    distance = steps.sum()
    first, last = np.searchsorted(samples, world.steady_frames[[0, -1]])
    heading = mean_heading(match, poses)
    return {
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
        "speed": float(distance / motion.duration) if motion.duration > 0 else 0.0,
        "travel": (hips[last] - hips[first]).tolist(),
        "heading_deg": None if heading is None else float(np.degrees(heading)),
        "jumps": [asdict(jump) for jump in world.jumps],
        "warnings": [*playing_warnings(world), *posture_warnings(world, poses)],
        **_check_summary(world, retargeter),
    }


def _floor(world: WorldMotion) -> float:
    """Height of the floor on the up axis of the file, file units."""
    upward = axis_vector(world.frame.up)
    steady = world.steady_frames
    points = world.motion.world_positions(steady[_sample_frames(len(steady))])
    return floor_height((points @ upward).min(-1)) * float(upward.sum())


def _check_summary(world: WorldMotion, retargeter: Retargeter) -> dict[str, Any]:
    """Check feet, joint limits and penetration on a skeleton."""
    times = world.frame_times[:_MAX_CHECKED]
    poses = world.sample(times)
    posed = retargeter.pose(poses)
    rotations, _ = retargeter.apply(poses)
    skeleton = retargeter.skeleton
    stances = find_stances(skeleton, posed, times)
    return {
        "checked_frames": len(times),
        "stances": len(stances),
        "slide": float(slide_distances(skeleton, posed, stances).mean() * 1e3) if stances else 0.0,
        "limits": [asdict(violation) for violation in load_limits().report(rotations)],
        "penetration": asdict(report_penetration(posed, fit_capsules(skeleton))),
    }
