"""The data plane: routes from publishers to peers and from peers to subscribers, and their quality of service."""
