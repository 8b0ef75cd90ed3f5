"""The formats of ROS 2 over Zenoh, as rmw_zenoh_cpp speaks them (its design.md), and conversion to ROS 1."""
