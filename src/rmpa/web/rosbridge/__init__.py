"""rosbridge v2 (ROSBRIDGE_PROTOCOL.md of RobotWebTools, branch ros1) without I/O, and the services of rosapi."""
