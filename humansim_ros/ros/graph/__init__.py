"""Watch a ROS graph (clocks, topics, publishers), and set up transport and quality of service."""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
