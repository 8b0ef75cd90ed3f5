"""Decides which profile to apply: pure, without I/O and clocks."""
