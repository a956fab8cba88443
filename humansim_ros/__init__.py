"""Synthetic ground truth of articulated humans for multi-camera trackers, over ROS 2 or in one process.

The public names are the names below and those that the folders export; docs/api.md lists them. All other
names are internal and may change. Names are imported on first use: importing the package takes milliseconds.
__init__.pyi names their modules.

Example:
    >>> from humansim_ros import Scene
    >>> scene = Scene.from_dict(
    ...     {
    ...         "humans": {"anna": {"body": "adult_woman", "motion": {"file": "walk"}}},
    ...         "cameras": {"front": {"position": [3, 0, 1.5], "look_at": [0, 0, 1]}},
    ...     }
    ... )
    >>> scene.cameras["front"].size
    (640, 480)
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

from humansim_ros.lazy import lazy_exports

__version__: str

_load, __dir__, __all__ = lazy_exports(__name__, __file__)


class _CallableFolder(ModuleType):
    """A folder that has the name of a public function: ``humansim_ros.record`` is both."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self.__wrapped__(*args, **kwargs)

    @property
    def __wrapped__(self) -> Callable[..., Any]:
        function: Callable[..., Any] = _load(self.__name__.rpartition(".")[2])
        return function


def make_callable(folder: str) -> None:
    """Let a folder be called as the public function of its name. ``folder``: its ``__name__``."""
    sys.modules[folder].__class__ = _CallableFolder


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from humansim_ros.io.assets import package_version

        return package_version()
    return _load(name)
