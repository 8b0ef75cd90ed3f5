"""The TCP links between peers: frames, handshake, keepalive, who dials whom (paper, section 4.4)."""
