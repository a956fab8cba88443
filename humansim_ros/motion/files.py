"""Motion files of any kind we read."""

from __future__ import annotations

import os
from pathlib import Path

from humansim_ros.motion.bvh import PositionChannels, read_bvh
from humansim_ros.motion.kinematics import Motion

_GLTF = (".gltf", ".glb")


def split_name(name: str | os.PathLike[str]) -> tuple[str, str | None]:
    """File and animation of a name such as ``figure.glb#Walk``; None for the first animation."""
    text = os.fspath(name)
    file, mark, animation = text.rpartition("#")
    if mark and Path(file).suffix.lower() in _GLTF:
        return file, animation
    return text, None


def read_motion(path: str | os.PathLike[str], positions: PositionChannels = "auto") -> Motion:
    """Read a BVH file, or an animation of a glTF file (``figure.glb#Walk``, or its first). MotionError if it
    is neither. ``positions``: what position channels of BVH mean.
    """
    file, animation = split_name(path)
    if Path(file).suffix.lower() in _GLTF:
        from humansim_ros.motion.gltf_motion import read_gltf_motion  # half of what starting takes

        return read_gltf_motion(file, animation)
    return read_bvh(file, positions)
