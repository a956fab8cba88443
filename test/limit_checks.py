"""How far poses are beyond joint limits, from what clamping changes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from humansim_ros.motion.pose import JointLimits


def degrees_beyond(limits: JointLimits, rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Degrees (N, B) by which clamping turns each bone in rotations (N, B, 4); 0 within the limits."""
    return degrees_between(limits.clamp(rotations), rotations)


def bones_beyond(limits: JointLimits, rotations: NDArray[np.float64]) -> list[str]:
    """Names of the bones that are beyond a limit by more than rounding in any frame."""
    beyond = (degrees_beyond(limits, rotations) > 1e-4).any(0)
    return [limits.skeleton.names[bone] for bone in np.flatnonzero(beyond)]


def degrees_between(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles (...) between rotations (..., 4)."""
    difference = Rotation.from_quat(a.reshape(-1, 4)).inv() * Rotation.from_quat(b.reshape(-1, 4))
    return np.degrees(difference.magnitude()).reshape(a.shape[:-1])
