"""The parts of the neighbour zenoh-bridge-ros1 that do I/O."""
