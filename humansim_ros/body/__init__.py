"""Skeletons, fitting of skeletons to meshes, rigging and skinning."""

from humansim_ros import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
