"""The sessions of the peers with their proxies and requests, and what the parts of the bridge share."""
