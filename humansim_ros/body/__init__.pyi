from humansim_ros.body.face_actions import expression as expression
from humansim_ros.body.fitting import fit_skeleton as fit_skeleton
from humansim_ros.body.fitting import fit_to_skeleton as fit_to_skeleton
from humansim_ros.body.rigging import rig as rig
from humansim_ros.body.skeleton import Skeleton as Skeleton
from humansim_ros.body.skeleton import hanim_skeleton as hanim_skeleton
from humansim_ros.body.skinning import skin as skin
