"""XML-RPC over HTTP: one server for each node and core, and calls to others."""
