"""ROS cores, as the agent uses them: the embedded core, and a real roscore that runs already."""
