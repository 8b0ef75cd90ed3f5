"""The gateway's own graph, as its neighbours use it."""
