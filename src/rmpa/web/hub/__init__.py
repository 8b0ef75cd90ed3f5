"""The hub: what all clients share of the ROS side, and the values by which sessions talk to it."""
