"""Synthetic ground truth of articulated humans for multi-camera trackers, over ROS 2 or in one process."""

__version__ = "0.1.0"
