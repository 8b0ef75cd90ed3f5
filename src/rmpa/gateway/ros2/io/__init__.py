"""ROS 2 over Zenoh as a neighbour of the gateway: its graph, its topics, and the parts that join them to the mesh."""
