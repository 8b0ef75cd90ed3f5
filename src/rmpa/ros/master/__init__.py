"""The ROS master and parameter server as pure data: calls go in, replies and notifications come out."""
