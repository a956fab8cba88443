"""Motions: files, forward kinematics, joint matching and retargeting."""

from humansim_ros.motion.bvh import read_bvh, write_bvh
from humansim_ros.motion.files import read_motion
from humansim_ros.motion.joint_match import JointMatch
from humansim_ros.motion.joint_matching import match_motion
from humansim_ros.motion.joint_poses import JointPoses, Velocity
from humansim_ros.motion.joint_tables import JointTable
from humansim_ros.motion.kinematics import Motion
from humansim_ros.motion.retarget import Retargeter
from humansim_ros.motion.world_motion import Placement, WorldMotion

__all__ = [
    "JointMatch",
    "JointPoses",
    "JointTable",
    "Motion",
    "Placement",
    "Retargeter",
    "Velocity",
    "WorldMotion",
    "match_motion",
    "read_bvh",
    "read_motion",
    "write_bvh",
]
