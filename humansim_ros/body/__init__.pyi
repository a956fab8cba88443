from humansim_ros.motion import Skeleton as Skeleton
from humansim_ros.motion import expression as expression
from humansim_ros.motion import hanim_skeleton as hanim_skeleton
from humansim_ros.motion import skin as skin
from humansim_ros.people import fit_skeleton as fit_skeleton
from humansim_ros.people import fit_to_skeleton as fit_to_skeleton
from humansim_ros.people import rig as rig
