"""What a motion file is: everything that was found out about it, in numbers and words."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.body.skeleton import Skeleton, hanim_skeleton
from humansim_ros.errors import HumansimError, HumansimWarning
from humansim_ros.motion.bvh import Motion, Positions, read_bvh
from humansim_ros.motion.contacts import find_stances, slides
from humansim_ros.motion.joint_names import JointMatch, match_motion
from humansim_ros.motion.limits import load_limits
from humansim_ros.motion.penetration import capsules, report_penetration
from humansim_ros.motion.retarget import Mode, Retargeter
from humansim_ros.motion.world import WorldMotion, understand

#: Frames that are looked at for what takes long; of longer motions, every so many.
_MOST_FRAMES = 2000


@dataclass(frozen=True)
class MotionInfo:
    """What is known about a motion file; None where it could not be known (``unknown`` says why).

    ``positions``: whether position channels replace the OFFSET or are added. ``bounds``: lowest and highest
    joint position, file units and axes. ``stature``: metres. ``root_scale``: what the root's way is scaled by
    onto the general skeleton. ``speed``: metres a second over the floor, on average. ``slide``: mm of way
    over the floor of a standing foot, mean of its ``stances``. ``limits``: joint limits that are passed.
    ``penetration``: worst depth of limbs in each other, mm.
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
    root_scale: float | None = None
    speed: float | None = None
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
    """Read a BVH file and keep its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = read_bvh(path, positions)
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
    frame = understand(motion, match, unit, up, facing)
    return WorldMotion(motion, match, frame, **{"loop": "none", **options})


def describe_motion(
    read: Read, world: Callable[[Motion], WorldMotion] = world_of, mode: Mode = "full"
) -> MotionInfo:
    """All that can be said of a motion; of one that is no person, less."""
    motion = read.motion
    some = np.unique(np.linspace(0, motion.n_frames - 1, _MOST_FRAMES).astype(int))
    points = motion.world_positions(some)
    ends = [
        j for j, name in enumerate(motion.joint_names) if name.endswith("_end") and not motion.channels[j]
    ]
    moved = [
        name
        for name, channels in zip(motion.joint_names, motion.channels, strict=True)
        if any(channel.endswith("position") for channel in channels)
    ]
    facts: dict[str, Any] = {
        "path": motion.path,
        "frames": motion.n_frames,
        "frame_time": motion.frame_time,
        "rate": 1 / motion.frame_time,
        "seconds": motion.duration,
        "joints": motion.n_joints - len(ends),
        "end_sites": len(ends),
        "roots": [motion.joint_names[j] for j in np.flatnonzero(motion.parents < 0)],
        "channels": motion.values.shape[1],
        "positions": motion.positions,
        "position_joints": moved,
        "bounds": [points.min((0, 1)).tolist(), points.max((0, 1)).tolist()],
        "warnings": read.warnings,
    }
    try:
        placed = world(motion)
    except HumansimError as error:
        return MotionInfo(**facts, unknown=error.message)
    return MotionInfo(**facts, **_of_person(placed, hanim_skeleton(), mode))


def _of_person(world: WorldMotion, skeleton: Skeleton, mode: Mode) -> dict[str, Any]:
    motion, match, frame = world.motion, world.match, world.frame
    retargeter = Retargeter.fit(world, skeleton, mode)
    times = world.frame_times[: 2 * _MOST_FRAMES]
    poses = world.sample(times)
    posed = retargeter.pose(poses)
    rotations, _ = retargeter.apply(poses)
    stances = find_stances(skeleton, posed, times)
    way = np.linalg.norm(np.diff(poses.positions[:, match.roles["Hips"], :2], axis=0), axis=-1).sum()
    return {
        "table": match.table,
        "found_by": match.by,
        "confidence": match.confidence,
        "missing_bones": list(match.missing),
        "roles": _named(match, motion),
        "up": frame.up,
        "facing": frame.facing,
        "rest": "OFFSETs" if frame.rest_stands else "straightest frame",
        "unit": frame.unit,
        "unit_name": frame.unit_name,
        "stature": frame.stature,
        "root_scale": retargeter.scale,
        "speed": float(way / times[-1]) if times[-1] > 0 else 0.0,
        "stances": len(stances),
        "slide": float(slides(skeleton, posed, stances).mean() * 1e3) if stances else 0.0,
        "limits": [asdict(violation) for violation in load_limits().report(rotations)],
        "penetration": asdict(report_penetration(posed, capsules(skeleton))),
    }


def _named(match: JointMatch, motion: Motion) -> dict[str, str]:
    return {role: motion.joint_names[joint] for role, joint in match.roles.items()}
