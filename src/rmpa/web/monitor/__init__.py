"""What the monitor's pages are told: a state, its changes as patches, live values, and places on the ring. Pure."""
