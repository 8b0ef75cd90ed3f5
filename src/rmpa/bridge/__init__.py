"""Joins the ROS side and the mesh: what crosses, which routes are open (paper, section 4.5)."""
