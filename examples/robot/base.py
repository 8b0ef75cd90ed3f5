"""A base's driver (rospy): it drives as it is told, at most as fast as a private parameter allows, and gets tired."""

import rospy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from sensor_msgs.msg import BatteryState

rospy.init_node("base_driver")
wheels = {"speed": 0.0}
rospy.Subscriber("/cmd_vel", Twist, lambda command: wheels.update(speed=command.linear.x))
odometry = rospy.Publisher("/odom", Odometry, queue_size=1)
battery = rospy.Publisher("/battery", BatteryState, queue_size=1)
rate = rospy.Rate(10)
while not rospy.is_shutdown():
    here = Odometry()
    here.header.stamp = rospy.Time.now()
    here.twist.twist.linear.x = min(wheels["speed"], rospy.get_param("~max_speed", 1.0))
    odometry.publish(here)
    battery.publish(BatteryState(percentage=rospy.get_param("/charge", 0.9)))
    rate.sleep()
