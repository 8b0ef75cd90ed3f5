"""Looks at the machine: sockets, files below /proc, other programs."""
