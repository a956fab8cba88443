"""Programs that use ROS: demo, benchmark, bag player; and layouts for RViz and Foxglove."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
