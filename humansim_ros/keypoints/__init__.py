"""Keypoint sets of detectors and motion capture: their tables, and their places on a human."""

from humansim_ros.keypoints.locator import KeypointLocator
from humansim_ros.keypoints.sets import KEYPOINT_SETS, KeypointSet, keypoint_set

__all__ = ["KEYPOINT_SETS", "KeypointLocator", "KeypointSet", "keypoint_set"]
