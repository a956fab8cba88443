"""Recording of scenes to bags without ROS nodes: plan, messages, workers, cluster."""
