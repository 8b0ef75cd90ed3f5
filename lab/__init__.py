"""The laboratory: measures RMPA beside classic ROS and other middleware. Runs from a clone, is no part of the wheel.

``bed`` has the hosts, processes and agents that measurements and tests start, ``nodes`` the ROS nodes, ``bench`` the
single measurements (``make bench``) and ``experiments`` the paper's evaluation (``make experiment``).
"""
