"""What a motion file is: everything that was found out about it, in numbers and words."""

from __future__ import annotations

import warnings
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.skeleton import Skeleton, hanim_skeleton
from humansim_ros.errors import HumansimWarning, MotionError
from humansim_ros.motion.bvh import Positions
from humansim_ros.motion.file_frame import axis_vector, detect_file_frame
from humansim_ros.motion.files import read_motion
from humansim_ros.motion.joint_match import JointMatch
from humansim_ros.motion.joint_matching import match_motion
from humansim_ros.motion.joint_poses import JointPoses
from humansim_ros.motion.kinematics import Motion
from humansim_ros.motion.limits import load_limits
from humansim_ros.motion.penetration import fit_capsules, report_penetration
from humansim_ros.motion.retarget import Retargeter
from humansim_ros.motion.stances import find_stances, slide_distances
from humansim_ros.motion.world_motion import WorldMotion, floor_height
from humansim_ros.rotations import quaternion_to_matrix
from humansim_ros.types import Array

#: Frames, all over the motion, that are looked at for where it is; more would tell the same.
_SAMPLES = 2000
#: Frames, one after the other from the first, that feet, limits and limbs are looked at in.
_MAX_CHECKED = 4000
#: Headings of which this little is left when they are averaged have no common direction.
_COMMON = 0.3


@dataclass(frozen=True)
class MotionInfo:
    """What is known about a motion file; None where it could not be known (``unknown`` says why).

    Of the file: ``joints`` without its ``end_sites``; ``channel_layouts``: how many joints have which
    channels, as "Zrotation Xrotation Yrotation"; ``positions``: whether position channels replace the OFFSET
    or are added, and the joints that have some; ``bounds``: lowest and highest joint position, file units and
    axes.

    Of the person: ``table``, ``found_by``, ``confidence``, ``roles`` (role -> joint) and ``missing_bones``
    (that nothing drives) of the joints; ``up`` and ``facing``: file axes, and the ``rest`` pose they are
    found in; ``unit``: metres; ``stature``: metres; ``floor``: its height on the up axis, file units;
    ``root_scale``: what the root's way is scaled by onto the general skeleton; ``speed``: metres a second
    over the floor, on average; ``travel``: x and y from the first frame to the last and ``heading_deg``:
    where it faces on average, both with the rest pose facing +x, y to its left; None if it faces all ways.

    In the first ``checked_frames``: ``stances`` and ``slide`` (mm over the floor of a standing foot, mean of
    them); ``limits``: joint limits that are passed; ``penetration``: the worst of limbs in each other.
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
    checked_frames: int | None = None
    stances: int | None = None
    slide: float | None = None
    limits: list[dict[str, Any]] | None = None
    penetration: dict[str, Any] | None = None
    unknown: str | None = None
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return {**asdict(self), "warnings": list(self.warnings)}


@dataclass(frozen=True)
class Read:
    """A motion file as it was read, with what there was to warn of."""

    motion: Motion
    warnings: tuple[str, ...]


def read_quietly(path: Path, positions: Positions = "auto") -> Read:
    """Read a motion file and keep its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = read_motion(path, positions)
    texts = [str(w.message) for w in caught if issubclass(w.category, HumansimWarning)]
    return Read(motion, tuple(texts))


def world_of(
    motion: Motion,
    table: str | None = None,
    unit: float | None = None,
    up: str | None = None,
    facing: str | None = None,
    **options: Any,
) -> WorldMotion:
    """A motion in the world, by what is found or said. ``options``: those of :class:`WorldMotion`."""
    match = match_motion(motion, table)
    frame = detect_file_frame(motion, match, unit, up, facing)
    return WorldMotion(motion, match, frame, **{"loop": "none", **options})


def describe_motion(
    read: Read,
    table: str | None = None,
    unit: float | None = None,
    up: str | None = None,
    facing: str | None = None,
) -> MotionInfo:
    """All that can be said of a motion; of one that is no person, less.

    ``table``, ``unit``, ``up`` and ``facing`` may be said instead of found. Raises MotionError where they are
    wrong.
    """
    for axis in (up, facing):
        if axis is not None:
            axis_vector(axis)
    try:
        world = world_of(read.motion, table, unit, up, facing)
    except MotionError as error:
        if table is not None or _is_known(read.motion):
            raise  # it is what was said that does not fit
        return MotionInfo(**_of_file(read), unknown=error.message)
    return MotionInfo(**_of_file(read), **_of_person(world, hanim_skeleton()))


def headings(match: JointMatch, poses: JointPoses) -> Array:
    """Where the hips face (N, 2): x and y in ``map``, of length 0 to 1 as they are upright."""
    hips = quaternion_to_matrix(poses.rotations[:, match.roles["Hips"]])
    return np.asarray(hips[:, :2, 0])


def mean_heading(match: JointMatch, poses: JointPoses) -> float | None:
    """Direction (radians in ``map``) of all :func:`headings` together; None if they have none in common."""
    x, y = headings(match, poses).mean(0)
    return float(np.arctan2(y, x)) if np.hypot(x, y) > _COMMON else None


def _is_known(motion: Motion) -> bool:
    try:
        world_of(motion)
    except MotionError:
        return False
    return True


def _spread(frames: int) -> NDArray[np.intp]:
    """Numbers of some frames, all over a motion."""
    return np.unique(np.linspace(0, frames - 1, _SAMPLES).astype(np.intp))


def _of_file(read: Read) -> dict[str, Any]:
    motion = read.motion
    points = motion.world_positions(_spread(motion.n_frames))
    ends = [
        j for j, name in enumerate(motion.joint_names) if name.endswith("_end") and not motion.channels[j]
    ]
    moved = [
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
        "position_joints": moved,
        "bounds": [points.min((0, 1)).tolist(), points.max((0, 1)).tolist()],
        "warnings": read.warnings,
    }


def _of_person(world: WorldMotion, skeleton: Skeleton) -> dict[str, Any]:
    motion, match, frame = world.motion, world.match, world.frame
    retargeter = Retargeter.fit(world, skeleton)
    poses = world.sample(_spread(motion.n_frames) * motion.frame_time)
    hips = poses.positions[:, match.roles["Hips"], :2]
    way = np.linalg.norm(np.diff(hips, axis=0), axis=-1).sum()
    heading = mean_heading(match, poses)
    return {
        "table": match.table,
        "found_by": match.by,
        "confidence": match.confidence,
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
        "speed": float(way / motion.duration) if motion.duration > 0 else 0.0,
        "travel": (hips[-1] - hips[0]).tolist(),
        "heading_deg": None if heading is None else float(np.degrees(heading)),
        **_checked(world, retargeter),
    }


def _floor(world: WorldMotion) -> float:
    """Height of the floor on the file's up axis, file units."""
    upward = axis_vector(world.frame.up)
    points = world.motion.world_positions(_spread(world.motion.n_frames))
    return floor_height((points @ upward).min(-1)) * float(upward.sum())


def _checked(world: WorldMotion, retargeter: Retargeter) -> dict[str, Any]:
    """What is right or wrong with it on a skeleton."""
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
