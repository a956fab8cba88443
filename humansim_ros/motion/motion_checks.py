"""Plausibility checks of a motion in ``map``: confidence of its joints, jumps, knees and trunk."""

from __future__ import annotations

import numpy as np

from humansim_ros.errors import some_of
from humansim_ros.motion.kinematics import JointPoses
from humansim_ros.motion.world_motion import WorldMotion, leading_rest
from humansim_ros.rotations import unit_vectors
from humansim_ros.types import Array

#: Most jumps that a message lists.
_MAX_LISTED = 3
#: A knee bends backwards if it is behind the line from hip to ankle by this share of the length of the line.
_BACKWARDS = 0.05
#: The trunk lies if the cosine of its angle with the vertical is smaller.
_LYING = 0.5
#: Share of the frames from which knees or trunk are worth a warning.
_MOST = 0.5


def playing_warnings(world: WorldMotion) -> list[str]:
    """What the user of a scene must know of a motion: a low confidence, rest frames and jumps."""
    warnings = [] if world.match.warning is None else [world.match.warning]
    jumps = list(world.jumps)
    frame_time = world.motion.frame_time
    if rest := leading_rest(world.motion, jumps):
        first = jumps.pop(0)
        frames = "frame 0 is a rest pose" if rest == 1 else f"frames 0 to {rest - 1} are a rest pose"
        remedy = f": start: {rest * frame_time:.9g} leaves it out" if rest < world.motion.n_frames - 1 else ""
        warnings.append(f"{frames}, {_metres(first.distance)} away from frame {rest}{remedy}")
    if jumps:
        texts = (f"{_metres(jump.distance)} to frame {jump.frame}" for jump in jumps)
        listed = some_of(texts, _MAX_LISTED, rest=", and {} more times")
        warnings.append(f"the person jumps {listed}: play a part without jumps (start, end)")
    return warnings


def posture_warnings(world: WorldMotion, poses: JointPoses) -> list[str]:
    """Signs of a damaged file or a wrong axis in most frames: knees bend backwards, the trunk lies."""
    roles, points = world.match.roles, poses.positions
    hips = (points[:, roles["LeftHip"]] + points[:, roles["RightHip"]]) / 2
    across = points[:, roles["LeftHip"]] - points[:, roles["RightHip"]]
    backwards = np.zeros(len(points), dtype=bool)
    for side in ("Left", "Right"):
        if f"{side}Ankle" in roles:
            hip, knee, ankle = (points[:, roles[side + part]] for part in ("Hip", "Knee", "Ankle"))
            backwards |= _in_front(knee, hip, ankle, across) < -_BACKWARDS
    warnings = []
    if (share := float(backwards.mean())) > _MOST:
        warnings.append(
            f"a knee bends backwards in {share:.0%} of the frames: left and right are exchanged, or the "
            "file is damaged"
        )
    if all(f"{side}Shoulder" in roles for side in ("Left", "Right")):
        shoulders = (points[:, roles["LeftShoulder"]] + points[:, roles["RightShoulder"]]) / 2
        lies = unit_vectors(shoulders - hips)[:, 2] < _LYING
        if (share := float(lies.mean())) > _MOST:
            warnings.append(
                f"the trunk lies in {share:.0%} of the frames, with {world.frame.up} up: if the person does "
                "not lie, give the up axis of the file (up), or the file is damaged"
            )
    return warnings


def _in_front(knee: Array, hip: Array, ankle: Array, across: Array) -> Array:
    """How far knees are in front of the line from hip to ankle, as shares of its length (F,).

    Args:
        knee: Positions of the knees, (F, 3).
        hip: Positions of the hips, (F, 3).
        ankle: Positions of the ankles, (F, 3).
        across: Directions from the right to the left of the body, (F, 3).
    """
    line = hip - ankle
    length = np.maximum(np.linalg.norm(line, axis=1), 1e-9)
    forward = unit_vectors(np.cross(across, line))
    return np.asarray(((knee - ankle) * forward).sum(1) / length)


def _metres(distance: float) -> str:
    return f"{distance:.2f} m" if distance < 10 else f"{distance:.4g} m"
