"""The paper's evaluation as a tool: classic ROS beside RMPA, on the same machine, with the same nodes."""
