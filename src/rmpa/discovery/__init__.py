"""Discovery of peers: beacons, membership, leases and heartbeats (paper, section 4.3)."""
