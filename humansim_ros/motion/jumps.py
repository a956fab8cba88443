"""Jumps of a person from one frame to the next: rest frames at the origin, frames that are far away."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from humansim_ros.motion.kinematics import Motion
from humansim_ros.types import Array

#: A person is slower, m/s, and moves less in one frame, metres. The fastest run is 12.4 m/s.
_MAX_SPEED, _MIN_DISTANCE = 15.0, 0.3
#: Frames between two jumps are an error of the recording if they last less than this, seconds, and less than
#: this share of the longest part without a jump.
_ERROR_SECONDS, _ERROR_SHARE = 0.5, 0.25
#: Channels of a person that stands still vary by less than this, degrees or file units.
_STILL = 0.1


@dataclass(frozen=True)
class Jump:
    """A jump to ``frame`` from the frame before it, over a ``distance`` in metres."""

    frame: int
    distance: float


def joint_path(motion: Motion, joint: int) -> Array:
    """Positions (F, 3) of one joint in all frames, file units; computes only the joints above it."""
    chain = [joint]
    while motion.parents[chain[0]] >= 0:
        chain.insert(0, int(motion.parents[chain[0]]))
    columns = [column for one in chain for column in motion.columns(one)]
    above = replace(
        motion,
        joint_names=tuple(motion.joint_names[one] for one in chain),
        parents=np.arange(len(chain)) - 1,
        offsets=motion.offsets[chain],
        channels=tuple(motion.channels[one] for one in chain),
        values=motion.values[:, columns],
    )
    return above.world_positions()[:, -1]


def find_jumps(path: Array, frame_time: float) -> tuple[Jump, ...]:
    """Jumps of a joint that is at ``path`` (F, 3), metres.

    A jump is a step that is too long for a person, and that neither the step before it nor the step after
    it is like. A person in a car does not jump.
    """
    if len(path) < 2:
        return ()
    steps = np.diff(path, axis=0)
    limit = max(_MIN_DISTANCE, _MAX_SPEED * frame_time)
    changes = np.linalg.norm(np.diff(steps, axis=0), axis=1)
    lengths = np.linalg.norm(steps, axis=1)
    jumps = (lengths > limit) & (np.append(np.inf, changes) > limit) & (np.append(changes, np.inf) > limit)
    return tuple(Jump(int(step) + 1, float(lengths[step])) for step in np.flatnonzero(jumps))


def leading_rest(motion: Motion, jumps: Sequence[Jump]) -> int:
    """Number of frames before the first jump in which a rest pose does not move; 0 without such frames.

    Programs write the rest pose at the origin as first frame, and the person elsewhere. All rotations are
    zero in a rest pose; or the root is at the origin of the file or above it, in fewer than half of the
    frames.
    """
    first = jumps[0].frame if jumps else 0
    before = motion.values[:first]
    if not before.size or np.ptp(before, axis=0).max() > _STILL:
        return 0
    rotations = [
        column
        for joint, names in enumerate(motion.channels)
        for column, name in zip(motion.columns(joint), names, strict=True)
        if name.endswith("rotation")
    ]
    is_zero = np.abs(before[:, rotations]).max(initial=0.0) < _STILL
    at_origin = [
        abs(before[0, c]) < _STILL for joint, _, c in motion.position_columns if motion.parents[joint] < 0
    ]
    is_at_origin = sum(at_origin) >= 2 and 2 * first < motion.n_frames
    return first if is_zero or is_at_origin else 0


def steady_frames(motion: Motion, jumps: Sequence[Jump]) -> NDArray[np.bool_]:
    """Whether each frame (F,) tells where the person is: neither leading rest frames nor errors do."""
    steady = np.ones(motion.n_frames, dtype=bool)
    if not jumps:
        return steady
    edges = [0, *(jump.frame for jump in jumps), motion.n_frames]
    lengths = np.diff(edges)
    shortest = min(_ERROR_SECONDS / motion.frame_time, _ERROR_SHARE * lengths.max())
    for start, length in zip(edges, lengths.tolist(), strict=False):
        steady[start : start + length] = length >= shortest
    steady[: leading_rest(motion, jumps)] = False
    return steady if steady.any() else ~steady
