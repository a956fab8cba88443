from humansim_ros.data import Comparison as Comparison
from humansim_ros.ros import foxglove_layout as foxglove_layout
from humansim_ros.ros import rviz_layout as rviz_layout
