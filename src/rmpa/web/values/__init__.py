"""ROS 1 bytes to values for JSON and CBOR, and back; compiled once for each type. Pure."""
