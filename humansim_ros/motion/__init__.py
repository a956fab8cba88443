"""Motion files, joint names and retargeting."""

from humansim_ros.motion.bvh import read_bvh, write_bvh
from humansim_ros.motion.files import read_motion
from humansim_ros.motion.kinematics import Motion

__all__ = ["Motion", "read_bvh", "read_motion", "write_bvh"]
