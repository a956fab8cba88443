"""Deprecated path of :mod:`humansim_ros.apps.viewer_layouts`."""

from __future__ import annotations

import warnings

from humansim_ros.apps.viewer_layouts import foxglove_layout, rviz_layout

__all__ = ["foxglove_layout", "rviz_layout"]
warnings.warn(f"{__name__} is humansim_ros.apps.viewer_layouts", DeprecationWarning, stacklevel=2)
