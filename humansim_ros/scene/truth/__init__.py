"""Compute ground truth (joints, keypoints, boxes, visibility) from a rendered view and the scene."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
