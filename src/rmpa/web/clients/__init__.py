"""WebSocket clients: rosbridge v2, the Foxglove WebSocket protocol and the pages, over the hub."""
