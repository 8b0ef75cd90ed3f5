"""Message, service and action types: their definitions and md5 sums, the search for them, and messages as objects."""
