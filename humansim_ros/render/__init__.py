"""Render views: images and per-pixel ground truth of meshes as cameras see them."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
