"""Builders and readers of all messages of this package, one module for each family of topics.

Only standard message types are used. Stamps are integer nanoseconds. World poses are in ``map``, metres
(REP-103, REP-105).
"""

from humansim_ros.ros.messages.camera_truth import (
    BODY_KINDS,
    BOX_POINT,
    JOINT_POINT,
    VISIBLE_VERTEX,
    boxes_message,
    joint_view_message,
    read_boxes,
    read_joint_view,
    read_visible_vertices,
    visible_vertices_message,
)
from humansim_ros.ros.messages.cameras import (
    camera_info_message,
    extrinsics_message,
    pose_message,
    projection_message,
    read_camera_info,
    read_pose,
)
from humansim_ros.ros.messages.compressed import (
    DepthCompression,
    ImageCompression,
    compressed_depth_message,
    compressed_image_message,
)
from humansim_ros.ros.messages.faults import faults_legend, faults_message, read_faults
from humansim_ros.ros.messages.headers import (
    WORLD_FRAME,
    header,
    optical_frame,
    read_scene_time,
    scene_time_message,
    serialised_stamp,
    to_nanoseconds,
    to_time,
)
from humansim_ros.ros.messages.humans import (
    MarkerBuilder,
    joint_motion,
    joints_message,
    keypoints_message,
    mesh_message,
    motion_message,
    read_joints,
    read_vertices,
    vertices_message,
)
from humansim_ros.ros.messages.images import image_message, mask_pixels
from humansim_ros.ros.messages.legends import (
    instance_legend,
    joints_legend,
    keypoints_legend,
    live_legend,
    motion_legend,
    part_legend,
    read_motion_legend,
)
from humansim_ros.ros.messages.objects import object_message, read_object, read_twist, twist_message
from humansim_ros.ros.messages.points import point_cloud, read_points

__all__ = [
    "BODY_KINDS",
    "BOX_POINT",
    "JOINT_POINT",
    "VISIBLE_VERTEX",
    "WORLD_FRAME",
    "DepthCompression",
    "ImageCompression",
    "MarkerBuilder",
    "boxes_message",
    "camera_info_message",
    "compressed_depth_message",
    "compressed_image_message",
    "extrinsics_message",
    "faults_legend",
    "faults_message",
    "header",
    "image_message",
    "instance_legend",
    "joint_motion",
    "joint_view_message",
    "joints_legend",
    "joints_message",
    "keypoints_legend",
    "keypoints_message",
    "live_legend",
    "mask_pixels",
    "mesh_message",
    "motion_legend",
    "motion_message",
    "object_message",
    "optical_frame",
    "part_legend",
    "point_cloud",
    "pose_message",
    "projection_message",
    "read_boxes",
    "read_camera_info",
    "read_faults",
    "read_joint_view",
    "read_joints",
    "read_motion_legend",
    "read_object",
    "read_points",
    "read_pose",
    "read_scene_time",
    "read_twist",
    "read_vertices",
    "read_visible_vertices",
    "scene_time_message",
    "serialised_stamp",
    "to_nanoseconds",
    "to_time",
    "twist_message",
    "vertices_message",
    "visible_vertices_message",
]
