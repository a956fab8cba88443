"""Messages of other people stacks, such as vision_msgs and ROS4HRI (docs/people_messages.md)."""
