"""ROS nodes that run in this process: publications, subscriptions and services at one address."""
