"""Motion files in, poses of a skeleton out."""

from humansim_ros.motion.bvh import Motion, read_bvh, write_bvh

__all__ = ["Motion", "read_bvh", "write_bvh"]
