from humansim_ros.ros.tools.viewer_layouts import foxglove_layout as foxglove_layout
from humansim_ros.ros.tools.viewer_layouts import rviz_layout as rviz_layout
