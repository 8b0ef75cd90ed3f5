"""The ROS core, nodes and TCPROS connections on asyncio."""
