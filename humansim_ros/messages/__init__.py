"""Messages of this package and of trackers: their classes, builders and readers, and the table of all topics.

Each module has one family of topics. Only standard message types are used. Stamps are integer nanoseconds.
World poses are in ``map``, metres (REP-103, REP-105). Without ROS, the classes of messages are made from
rosbags' definitions.
"""

from typing import TYPE_CHECKING

from humansim_ros import lazy_exports

if TYPE_CHECKING:
    from humansim_ros.messages.camera_truth import BODY_KINDS as BODY_KINDS
    from humansim_ros.messages.camera_truth import BOX_POINT as BOX_POINT
    from humansim_ros.messages.camera_truth import JOINT_POINT as JOINT_POINT
    from humansim_ros.messages.camera_truth import VISIBLE_VERTEX as VISIBLE_VERTEX
    from humansim_ros.messages.camera_truth import boxes_message as boxes_message
    from humansim_ros.messages.camera_truth import faults_message as faults_message
    from humansim_ros.messages.camera_truth import joint_view_message as joint_view_message
    from humansim_ros.messages.camera_truth import overlay_message as overlay_message
    from humansim_ros.messages.camera_truth import read_boxes as read_boxes
    from humansim_ros.messages.camera_truth import read_faults as read_faults
    from humansim_ros.messages.camera_truth import read_joint_view as read_joint_view
    from humansim_ros.messages.camera_truth import read_visible_vertices as read_visible_vertices
    from humansim_ros.messages.camera_truth import visible_vertices_message as visible_vertices_message
    from humansim_ros.messages.cameras import camera_info_message as camera_info_message
    from humansim_ros.messages.cameras import extrinsics_message as extrinsics_message
    from humansim_ros.messages.cameras import object_message as object_message
    from humansim_ros.messages.cameras import pose_message as pose_message
    from humansim_ros.messages.cameras import projection_message as projection_message
    from humansim_ros.messages.cameras import read_camera_info as read_camera_info
    from humansim_ros.messages.cameras import read_extrinsics as read_extrinsics
    from humansim_ros.messages.cameras import read_object as read_object
    from humansim_ros.messages.cameras import read_pose as read_pose
    from humansim_ros.messages.cameras import read_region as read_region
    from humansim_ros.messages.cameras import read_twist as read_twist
    from humansim_ros.messages.cameras import twist_message as twist_message
    from humansim_ros.messages.headers import WORLD_FRAME as WORLD_FRAME
    from humansim_ros.messages.headers import header as header
    from humansim_ros.messages.headers import optical_frame as optical_frame
    from humansim_ros.messages.headers import read_scene_time as read_scene_time
    from humansim_ros.messages.headers import scene_time_message as scene_time_message
    from humansim_ros.messages.headers import serialised_stamp as serialised_stamp
    from humansim_ros.messages.headers import to_nanoseconds as to_nanoseconds
    from humansim_ros.messages.headers import to_time as to_time
    from humansim_ros.messages.humans import MarkerBuilder as MarkerBuilder
    from humansim_ros.messages.humans import joint_motion as joint_motion
    from humansim_ros.messages.humans import joints_message as joints_message
    from humansim_ros.messages.humans import keypoints_message as keypoints_message
    from humansim_ros.messages.humans import mesh_message as mesh_message
    from humansim_ros.messages.humans import motion_message as motion_message
    from humansim_ros.messages.humans import read_joints as read_joints
    from humansim_ros.messages.humans import read_mesh as read_mesh
    from humansim_ros.messages.humans import read_vertices as read_vertices
    from humansim_ros.messages.humans import vertices_message as vertices_message
    from humansim_ros.messages.images import DepthCompression as DepthCompression
    from humansim_ros.messages.images import ImageCompression as ImageCompression
    from humansim_ros.messages.images import compressed_depth_message as compressed_depth_message
    from humansim_ros.messages.images import compressed_image_message as compressed_image_message
    from humansim_ros.messages.images import image_message as image_message
    from humansim_ros.messages.images import mask_pixels as mask_pixels
    from humansim_ros.messages.images import read_compressed_depth as read_compressed_depth
    from humansim_ros.messages.images import read_compressed_image as read_compressed_image
    from humansim_ros.messages.images import read_image as read_image
    from humansim_ros.messages.images import read_pixels as read_pixels
    from humansim_ros.messages.legends import faults_legend as faults_legend
    from humansim_ros.messages.legends import instance_legend as instance_legend
    from humansim_ros.messages.legends import joints_legend as joints_legend
    from humansim_ros.messages.legends import keypoints_legend as keypoints_legend
    from humansim_ros.messages.legends import live_legend as live_legend
    from humansim_ros.messages.legends import motion_legend as motion_legend
    from humansim_ros.messages.legends import part_legend as part_legend
    from humansim_ros.messages.legends import read_legend as read_legend
    from humansim_ros.messages.points import point_cloud as point_cloud
    from humansim_ros.messages.points import read_points as read_points

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "BODY_KINDS": "camera_truth",
        "BOX_POINT": "camera_truth",
        "DepthCompression": "images",
        "ImageCompression": "images",
        "JOINT_POINT": "camera_truth",
        "MarkerBuilder": "humans",
        "VISIBLE_VERTEX": "camera_truth",
        "WORLD_FRAME": "headers",
        "boxes_message": "camera_truth",
        "camera_info_message": "cameras",
        "compressed_depth_message": "images",
        "compressed_image_message": "images",
        "extrinsics_message": "cameras",
        "faults_legend": "legends",
        "faults_message": "camera_truth",
        "header": "headers",
        "image_message": "images",
        "instance_legend": "legends",
        "joint_motion": "humans",
        "joint_view_message": "camera_truth",
        "joints_legend": "legends",
        "joints_message": "humans",
        "keypoints_legend": "legends",
        "keypoints_message": "humans",
        "live_legend": "legends",
        "mask_pixels": "images",
        "mesh_message": "humans",
        "motion_legend": "legends",
        "motion_message": "humans",
        "object_message": "cameras",
        "optical_frame": "headers",
        "overlay_message": "camera_truth",
        "part_legend": "legends",
        "point_cloud": "points",
        "pose_message": "cameras",
        "projection_message": "cameras",
        "read_boxes": "camera_truth",
        "read_camera_info": "cameras",
        "read_compressed_depth": "images",
        "read_compressed_image": "images",
        "read_extrinsics": "cameras",
        "read_faults": "camera_truth",
        "read_image": "images",
        "read_joint_view": "camera_truth",
        "read_joints": "humans",
        "read_legend": "legends",
        "read_mesh": "humans",
        "read_object": "cameras",
        "read_pixels": "images",
        "read_points": "points",
        "read_pose": "cameras",
        "read_region": "cameras",
        "read_scene_time": "headers",
        "read_twist": "cameras",
        "read_vertices": "humans",
        "read_visible_vertices": "camera_truth",
        "scene_time_message": "headers",
        "serialised_stamp": "headers",
        "to_nanoseconds": "headers",
        "to_time": "headers",
        "twist_message": "cameras",
        "vertices_message": "humans",
        "visible_vertices_message": "camera_truth",
    },
)
