"""Message, service and action types: definitions, md5 sums, where they are found, and messages as objects."""
