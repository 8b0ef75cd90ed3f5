"""The calls: endpoints of proxies, both ends of an open service, connections to the servers."""
