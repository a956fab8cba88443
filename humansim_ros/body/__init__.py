"""Bodies: skeletons, rigging and skinning."""

from humansim_ros.body.fitting import fit_skeleton, fit_to_skeleton
from humansim_ros.body.rigging import rig
from humansim_ros.body.skeleton import Skeleton, hanim_skeleton
from humansim_ros.body.skinning import skin

__all__ = ["Skeleton", "fit_skeleton", "fit_to_skeleton", "hanim_skeleton", "rig", "skin"]
