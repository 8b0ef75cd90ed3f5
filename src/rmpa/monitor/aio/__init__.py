"""The control socket, served and called."""
