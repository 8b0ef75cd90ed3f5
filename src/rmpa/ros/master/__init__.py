"""The ROS master and parameter server without I/O: calls go in, replies and notifications come out."""
