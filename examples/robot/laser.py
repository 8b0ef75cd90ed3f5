"""A laser's driver (rospy)."""

import rospy
from sensor_msgs.msg import LaserScan

rospy.init_node("laser")
scans = rospy.Publisher("/scan", LaserScan, queue_size=1)
rate = rospy.Rate(10)
while not rospy.is_shutdown():
    scan = LaserScan(range_max=10.0, ranges=[2.0] * 180)
    scan.header.stamp = rospy.Time.now()
    scans.publish(scan)
    rate.sleep()
