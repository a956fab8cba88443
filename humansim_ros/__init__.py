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

import re
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

__version__: str


def lazy_exports(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Export names of a package that are imported on first use (PEP 562).

    Args:
        package: ``__name__`` of the package.
        file: Its ``__file__``. The stub next to it (.pyi) imports the names from their modules.

    Returns:
        ``__getattr__``, ``__dir__`` and ``__all__`` of the package.
    """
    stub = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
    modules = {name: module for module, name in re.findall(r"(?m)^from (\S+) import (\w+) as", stub)}

    def load(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(modules[name]), name)

    names = sorted(modules)
    return load, lambda: names, names


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
