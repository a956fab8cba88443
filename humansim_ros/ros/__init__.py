"""ROS nodes, the processes that run them, and programs that use nodes."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
