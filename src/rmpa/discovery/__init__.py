"""Who is there: beacons, the roster of peers, leases and heartbeats (paper, section 4.3)."""
