"""Clients and servers of the measurement ``web``: foxglove-sdk's server beside ``rmpa web``."""
