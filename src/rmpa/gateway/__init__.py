"""The gateway: joins a mesh with other sites and with ROS 2 by Zenoh (docs/design/gateway.md)."""
