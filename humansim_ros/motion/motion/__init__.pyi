from humansim_ros.motion.motion.world_motion import Placement as Placement
from humansim_ros.motion.motion.world_motion import WorldMotion as WorldMotion
from humansim_ros.motion.motion.world_motion import floor_height as floor_height
from humansim_ros.motion.motion.world_motion import playing_warnings as playing_warnings
