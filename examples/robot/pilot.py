"""A controller (rospy): it drives by the laser, or slowly by the camera; a private parameter says by which."""

import rospy
from geometry_msgs.msg import Twist
from sensor_msgs.msg import Image, LaserScan

rospy.init_node("pilot_node")
commands = rospy.Publisher("/cmd_vel", Twist, queue_size=1)
seen = {"laser": rospy.Time(), "camera": rospy.Time()}
rospy.Subscriber("/scan", LaserScan, lambda _: seen.update(laser=rospy.Time.now()))
rospy.Subscriber("/image", Image, lambda _: seen.update(camera=rospy.Time.now()))
rate = rospy.Rate(10)
while not rospy.is_shutdown():
    eye = rospy.get_param("~eye", "camera")
    command = Twist()
    if rospy.Time.now() - seen[eye] < rospy.Duration(1):
        command.linear.x = {"laser": 1.0, "camera": 0.3}[eye]
    commands.publish(command)
    rate.sleep()
