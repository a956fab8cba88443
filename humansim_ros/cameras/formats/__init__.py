"""Formats of calibration files, one module per family of formats; ``writing.py`` lists all formats."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
