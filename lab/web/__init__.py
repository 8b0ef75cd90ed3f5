"""Clients and servers of the measurement ``web``: rosbridge_suite's and foxglove-sdk's server beside ``rmpa web``."""
