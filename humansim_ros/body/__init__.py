"""Bodies: skeletons, meshes, rigging and skinning."""

from humansim_ros.body.fitting import fit_skeleton, fit_to_skeleton
from humansim_ros.body.human import Human
from humansim_ros.body.mesh import Mesh
from humansim_ros.body.obj import read_mesh
from humansim_ros.body.rigging import rig
from humansim_ros.body.skeleton import Skeleton, hanim_skeleton
from humansim_ros.body.skinning import skin

__all__ = [
    "Human",
    "Mesh",
    "Skeleton",
    "fit_skeleton",
    "fit_to_skeleton",
    "hanim_skeleton",
    "read_mesh",
    "rig",
    "skin",
]
