"""Ground truth that follows from a view and the scene: joints, keypoints, boxes, vertices, surface points."""

from humansim_ros.humans.human import joint_surfaces
from humansim_ros.truth.camera_truth import (
    NOTHING,
    OCCLUDED,
    OUTSIDE,
    PERSON,
    SELF,
    THING,
    VISIBLE,
    BodyBox,
    CameraTruth,
    JointView,
    KeypointView,
    part_u_v,
    rest_points,
    view_boxes,
    view_joints,
    view_keypoints,
    visible_vertices,
)

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
    "KeypointView",
    "joint_surfaces",
    "part_u_v",
    "rest_points",
    "view_boxes",
    "view_joints",
    "view_keypoints",
    "visible_vertices",
]
