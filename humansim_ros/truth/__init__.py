"""Truth that follows from positions, cameras and label images: joints, boxes, vertices, surface points."""

from humansim_ros.truth.boxes import BodyBox
from humansim_ros.truth.joints import JointView
from humansim_ros.truth.surface import part_u_v, rest_points

__all__ = ["BodyBox", "JointView", "part_u_v", "rest_points"]
