"""What experiments run on: hosts and cables, processes, ROS shells, agents."""
