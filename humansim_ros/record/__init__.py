"""Recording of scenes to bags without ROS nodes: plan, messages, workers, cluster."""

from humansim_ros import make_callable

make_callable(__name__)
