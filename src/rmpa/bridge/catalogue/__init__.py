"""What modules offer each other: told in portions, under each peer's names, within limits; all kinds alike."""
