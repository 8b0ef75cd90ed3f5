"""ROS cores as the agent uses them: the embedded one, and a roscore that runs already."""
