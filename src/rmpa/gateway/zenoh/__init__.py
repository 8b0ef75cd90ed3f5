"""One Zenoh session of the gateway: its configuration, its threads, and its queues to and from the event loop."""
