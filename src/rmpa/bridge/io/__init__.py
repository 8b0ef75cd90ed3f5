"""The bridge itself, and its parts for nodes (list, ping, kill) and for limits."""
