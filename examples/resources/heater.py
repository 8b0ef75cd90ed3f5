"""A heater's driver, as many are: it knows nothing of RMPA, and reports by diagnostic_updater (rospy)."""

from typing import Any

import diagnostic_updater
import rospy
from std_msgs.msg import Float64

rospy.init_node("heater")
power = rospy.Publisher("~power", Float64, queue_size=1)
updater = diagnostic_updater.Updater()
updater.setHardwareID("none")
heat = 20.0


def element(status: Any) -> Any:
    """Say how hot it is."""
    status.summary(0, "warm")
    status.add("Temperature", round(heat, 1))
    return status


updater.add("Element", element)
rate = rospy.Rate(10)
while not rospy.is_shutdown():
    watts = rospy.get_param("~watts", 20)
    heat += (20 + 1.5 * watts - heat) * 0.05
    power.publish(watts)
    updater.update()
    rate.sleep()
