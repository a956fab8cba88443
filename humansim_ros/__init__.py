"""Synthetic ground truth of articulated humans for multi-camera trackers, over ROS 2 or in one process.

The public names are the names below and those that the packages export; docs/api.md lists them. All other
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

from typing import Any

from humansim_ros.lazy import lazy_exports

__version__: str

_load, __dir__, __all__ = lazy_exports(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from humansim_ros.files.reading.assets import package_version

        return package_version()
    return _load(name)
