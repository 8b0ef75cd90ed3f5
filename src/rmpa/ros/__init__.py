"""The ROS 1 side: master, parameter server, slave API, TCPROS and message types."""
