"""Evaluation of trackers: their estimates are compared with the truth, and errors are computed."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
