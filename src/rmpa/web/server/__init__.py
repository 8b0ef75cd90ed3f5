"""The HTTP server of ``rmpa web``: routes, access, limits of connections, and the agent's shared snapshot."""
