"""A robot's joint states at 50 Hz (rospy): ``joints``."""

import rospy
from sensor_msgs.msg import JointState

rospy.init_node("joints")
states = rospy.Publisher("joint_states", JointState, queue_size=1)
rate = rospy.Rate(50)
while not rospy.is_shutdown():
    message = JointState(name=["elbow"], position=[0.1])
    message.header.stamp = rospy.Time.now()
    states.publish(message)
    rate.sleep()
