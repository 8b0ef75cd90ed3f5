"""Direct transport: connections from node to node between two modules, arranged by their agents."""
