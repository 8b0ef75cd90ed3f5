"""WebSocket gateways: rosbridge v2 and the Foxglove WebSocket protocol, over the hub."""
