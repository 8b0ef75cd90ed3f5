"""The TCP links between peers: frames, handshake, keepalive, and which side dials (paper, section 4.4)."""
