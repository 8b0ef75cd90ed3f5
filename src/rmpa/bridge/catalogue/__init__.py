"""What modules offer each other: advertised in portions, under names that fit each peer, and within limits."""
