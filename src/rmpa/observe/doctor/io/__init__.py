"""Reads the machine for ``rmpa doctor``, and lists the checks."""
