"""ROS 2's half of the gateway: runs under ROS 2's own Python, 3.8 or later, and imports nothing of rmpa."""
