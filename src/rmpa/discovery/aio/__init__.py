"""Sockets, interfaces and timers that drive the roster."""
