"""Builders and readers of all messages, the table of topics. They need no ROS."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
