"""Skeletons, fitting of skeletons to meshes, rigging and skinning."""

import warnings
from importlib import import_module
from typing import Any

from humansim_ros.body.fitting import fit_skeleton, fit_to_skeleton
from humansim_ros.body.rigging import rig
from humansim_ros.body.skeleton import Skeleton, hanim_skeleton
from humansim_ros.body.skinning import skin

__all__ = ["Skeleton", "fit_skeleton", "fit_to_skeleton", "hanim_skeleton", "rig", "skin"]

_MOVED = {"Human": "humansim_ros.humans", "Mesh": "humansim_ros.mesh", "read_mesh": "humansim_ros.mesh"}


def moved(module: str, name: str) -> Any:
    """Find a name that has moved to another folder, with a DeprecationWarning. Aliases go in 0.3.0."""
    if name not in _MOVED:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    warnings.warn(f"import {name} from {_MOVED[name]}, not from {module}", DeprecationWarning, stacklevel=3)
    return getattr(import_module(_MOVED[name]), name)


def __getattr__(name: str) -> Any:
    return moved(__name__, name)
