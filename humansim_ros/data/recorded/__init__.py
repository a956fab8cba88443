"""Recorded messages: read all of some topics, or those of a frame in any order."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
