"""Read motion files of any supported format."""

from __future__ import annotations

import os
from pathlib import Path

from humansim_ros.errors import HumansimError, MotionError
from humansim_ros.io.assets import find_asset
from humansim_ros.motion.bvh import PositionChannels, read_bvh
from humansim_ros.motion.kinematics import Motion

#: Files that have animations of glTF; FBX files are converted to glTF.
_GLTF = (".gltf", ".glb", ".vrm", ".fbx")


def find_motion(name: str, folder: Path | None = None, error: type[HumansimError] = MotionError) -> str:
    """Path of a built-in motion or of a file, with the animation of a glTF file (``figure.glb#Walk``).

    ``folder``: folder that relative paths start from; the current folder if None. Raises ``error``.
    """
    file, animation = split_name(name)
    path = find_asset(file, "motions", folder, error)
    return str(path) if animation is None else f"{path}#{animation}"


def read_motion(path: str | os.PathLike[str], positions: PositionChannels = "auto") -> Motion:
    """Read a motion: a built-in (``walk``), a BVH file, or an animation of a glTF or FBX file.

    ``path``: name or file, such as ``figure.glb#Walk``; without ``#`` the first animation.
    ``positions``: meaning of the position channels of BVH; see :func:`~humansim_ros.motion.bvh.read_bvh`.

    Raises:
        MotionError: The file is not valid, or has no such animation.

    Example:
        >>> from humansim_ros import read_motion
        >>> round(read_motion("run").duration, 2)
        1.4
    """
    file, animation = split_name(path)
    if not Path(file).suffix:
        file = str(find_asset(file, "motions", error=MotionError))
    if Path(file).suffix.lower() in _GLTF:
        # imported on use: it takes as long as all other imports together
        from humansim_ros.motion.gltf_motion import read_gltf_motion

        return read_gltf_motion(file, animation)
    return read_bvh(file, positions)


def split_name(name: str | os.PathLike[str]) -> tuple[str, str | None]:
    """File and animation of a name such as ``figure.glb#Walk``; None without an animation."""
    text = os.fspath(name)
    file, mark, animation = text.rpartition("#")
    if mark and Path(file).suffix.lower() in _GLTF:
        return file, animation
    return text, None
