"""Builds the snapshot from the rooms, and serves it: control socket and ``/diagnostics``."""
