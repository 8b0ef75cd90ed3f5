"""The mesh's I/O: dials, accepts and drives the connections, and joins them to one link for each peer."""
