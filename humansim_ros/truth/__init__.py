"""Ground truth that follows from a view and the scene: joints, boxes, visible vertices, surface points."""

from humansim_ros.truth.boxes import BodyBox, view_boxes
from humansim_ros.truth.camera_truth import CameraTruth
from humansim_ros.truth.joints import (
    NOTHING,
    OCCLUDED,
    OUTSIDE,
    PERSON,
    SELF,
    THING,
    VISIBLE,
    JointView,
    joint_surfaces,
    view_joints,
)
from humansim_ros.truth.surface import part_u_v, rest_points
from humansim_ros.truth.vertices import visible_vertices

__all__ = [
    "NOTHING",
    "OCCLUDED",
    "OUTSIDE",
    "PERSON",
    "SELF",
    "THING",
    "VISIBLE",
    "BodyBox",
    "CameraTruth",
    "JointView",
    "joint_surfaces",
    "part_u_v",
    "rest_points",
    "view_boxes",
    "view_joints",
    "visible_vertices",
]
