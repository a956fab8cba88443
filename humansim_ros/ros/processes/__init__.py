"""Processes of nodes: which nodes a scene has, how their processes start and end, and options of time."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
