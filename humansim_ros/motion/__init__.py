"""Motions: files, forward kinematics, joint matching and retargeting."""

from typing import TYPE_CHECKING

from humansim_ros import lazy_exports

if TYPE_CHECKING:
    from humansim_ros.motion.bvh import read_bvh as read_bvh
    from humansim_ros.motion.bvh import write_bvh as write_bvh
    from humansim_ros.motion.files import read_motion as read_motion
    from humansim_ros.motion.info import to_world as to_world
    from humansim_ros.motion.joint_match import JointMatch as JointMatch
    from humansim_ros.motion.joint_matching import match_motion as match_motion
    from humansim_ros.motion.joint_tables import JointTable as JointTable
    from humansim_ros.motion.keyframes import read_keyframes as read_keyframes
    from humansim_ros.motion.kinematics import JointPoses as JointPoses
    from humansim_ros.motion.kinematics import Motion as Motion
    from humansim_ros.motion.kinematics import Velocity as Velocity
    from humansim_ros.motion.limits import load_limits as load_limits
    from humansim_ros.motion.penetration import fit_capsules as fit_capsules
    from humansim_ros.motion.penetration import report_penetration as report_penetration
    from humansim_ros.motion.retarget import Retargeter as Retargeter
    from humansim_ros.motion.world_motion import Placement as Placement
    from humansim_ros.motion.world_motion import WorldMotion as WorldMotion

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "JointMatch": "joint_match",
        "JointPoses": "kinematics",
        "JointTable": "joint_tables",
        "Motion": "kinematics",
        "Placement": "world_motion",
        "Retargeter": "retarget",
        "Velocity": "kinematics",
        "WorldMotion": "world_motion",
        "fit_capsules": "penetration",
        "load_limits": "limits",
        "match_motion": "joint_matching",
        "read_bvh": "bvh",
        "read_keyframes": "keyframes",
        "read_motion": "files",
        "report_penetration": "penetration",
        "to_world": "info",
        "write_bvh": "bvh",
    },
)
