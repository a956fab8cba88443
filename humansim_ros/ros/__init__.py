"""The ROS 2 nodes: messages, publishers, node processes."""
