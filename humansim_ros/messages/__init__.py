"""Messages of this package and of trackers: their classes, builders and readers, and the table of all topics.

Each module has one family of topics. Only standard message types are used. Stamps are integer nanoseconds.
World poses are in ``map``, metres (REP-103, REP-105). Without ROS, the classes of messages are made from
rosbags' definitions.
"""

from humansim_ros.lazy import lazy_exports

__getattr__, __dir__, __all__ = lazy_exports(__name__, __file__)
