"""Keypoint sets of detectors and motion capture: tables of their keypoints, and the places of these on a
human."""

from humansim_ros.keypoints.locator import KeypointLocator
from humansim_ros.keypoints.sets import KEYPOINT_SETS, KeypointSet, keypoint_set

__all__ = ["KEYPOINT_SETS", "KeypointLocator", "KeypointSet", "keypoint_set"]
