"""Data sets that are written from recipes, and the pages that describe them."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
