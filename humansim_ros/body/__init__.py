"""Skeletons, fitting of skeletons to meshes, rigging and skinning."""

import warnings
from importlib import import_module
from typing import TYPE_CHECKING, Any

from humansim_ros import lazy_exports

if TYPE_CHECKING:
    from humansim_ros.body.fitting import fit_skeleton as fit_skeleton
    from humansim_ros.body.fitting import fit_to_skeleton as fit_to_skeleton
    from humansim_ros.body.rigging import rig as rig
    from humansim_ros.body.skeleton import Skeleton as Skeleton
    from humansim_ros.body.skeleton import hanim_skeleton as hanim_skeleton
    from humansim_ros.body.skinning import skin as skin

_load, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "Skeleton": "skeleton",
        "fit_skeleton": "fitting",
        "fit_to_skeleton": "fitting",
        "hanim_skeleton": "skeleton",
        "rig": "rigging",
        "skin": "skinning",
    },
)

_MOVED = {"Human": "humansim_ros.humans", "Mesh": "humansim_ros.mesh", "read_mesh": "humansim_ros.mesh"}


def moved(module: str, name: str) -> Any:
    """Find a name that has moved to another folder, with a DeprecationWarning. Aliases go in 0.3.0."""
    if name not in _MOVED:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    warnings.warn(f"import {name} from {_MOVED[name]}, not from {module}", DeprecationWarning, stacklevel=3)
    return getattr(import_module(_MOVED[name]), name)


def __getattr__(name: str) -> Any:
    return _load(name) if name in __all__ else moved(__name__, name)
