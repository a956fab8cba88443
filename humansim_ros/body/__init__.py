"""Skeletons, fitting of skeletons to meshes, rigging and skinning."""

import warnings
from importlib import import_module
from typing import Any

from humansim_ros import lazy_exports

_load, __dir__, __all__ = lazy_exports(__name__, __file__)

_MOVED = {"Human": "humansim_ros.humans", "Mesh": "humansim_ros.mesh", "read_mesh": "humansim_ros.mesh"}


def moved(module: str, name: str) -> Any:
    """Find a name that has moved to another folder, with a DeprecationWarning. Aliases go in 0.3.0."""
    if name not in _MOVED:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    warnings.warn(f"import {name} from {_MOVED[name]}, not from {module}", DeprecationWarning, stacklevel=3)
    return getattr(import_module(_MOVED[name]), name)


def __getattr__(name: str) -> Any:
    return _load(name) if name in __all__ else moved(__name__, name)
