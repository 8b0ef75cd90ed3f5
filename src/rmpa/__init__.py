"""RMPA: ROS 1 modules with a core of their own that share topics, with no master between them."""

__version__ = "0.1.0"
