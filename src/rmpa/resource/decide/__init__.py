"""Decides which profile a resource applies. Pure: no I/O, no clocks."""
