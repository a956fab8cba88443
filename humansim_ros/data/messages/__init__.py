"""Functions that build and read all messages, and the list of all topics of a scene, all without ROS."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
