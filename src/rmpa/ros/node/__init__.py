"""ROS nodes of ours: publications, subscriptions and services at one address."""
