from humansim_ros.apps.api import Comparison as Comparison
from humansim_ros.apps.viewer_layouts import foxglove_layout as foxglove_layout
from humansim_ros.apps.viewer_layouts import rviz_layout as rviz_layout
