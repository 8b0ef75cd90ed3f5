"""The Foxglove WebSocket protocol, server side: messages (``protocol``) and one client's session (``session``)."""
