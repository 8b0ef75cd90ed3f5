"""What is known of each peer across its links, and what the parts of the bridge have in common."""
