"""A camera's driver (rospy), which knows nothing of RMPA: the width of its pictures is a private parameter."""

import rospy
from sensor_msgs.msg import Image

rospy.init_node("camera_driver")
images = rospy.Publisher("/image", Image, queue_size=2)
rate = rospy.Rate(10)
while not rospy.is_shutdown():
    width = int(rospy.get_param("~width", 320))
    height = width * 3 // 4
    image = Image(width=width, height=height, encoding="rgb8", step=3 * width, data=bytes(3 * width * height))
    image.header.stamp = rospy.Time.now()
    images.publish(image)
    rate.sleep()
