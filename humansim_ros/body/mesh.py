"""Deprecated path of :class:`humansim_ros.mesh.Mesh`."""

from typing import Any

from humansim_ros.body import moved


def __getattr__(name: str) -> Any:
    return moved(__name__, name)
