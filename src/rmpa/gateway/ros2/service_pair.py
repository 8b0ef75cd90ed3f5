"""A service type of ROS 1 and its counterpart in ROS 2: names, hash, conversion of requests and responses.

ROS 2 has no reply that says "the call failed". rmw_zenoh's client prints the text of a Zenoh error reply and goes on
waiting (rmw_data_types.cpp, ``client_data_handler``), so a failed call of ROS 1 is answered with one, never with an
empty response.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.gateway.ros2.conversion import Conversion, NoConversion

if TYPE_CHECKING:
    from rmpa.gateway.ros2.mapping import TypePair
    from rmpa.gateway.ros2.types import Ros2Types
    from rmpa.ros.types.installed import ServiceType

_LOGGERS: Final = "loggers of ROS 1 nodes have no counterpart in ROS 2"
_ROS1_WITHOUT_USE: Final = {
    "roscpp/GetLoggers": _LOGGERS,
    "roscpp/SetLoggerLevel": _LOGGERS,
    "dynamic_reconfigure/Reconfigure": "ROS 2 has parameters of nodes instead",
}
_ROS2_WITHOUT_USE: Final = {
    "rcl_interfaces": "ROS 1 has no parameters of nodes",
    "type_description_interfaces": "ROS 1 has definitions in the headers of its connections",
    "lifecycle_msgs": "ROS 1 has no managed nodes",
}
_ACTION_PART: Final = "/_action/"


_LOGGER_NAMES: Final = {"get_loggers": "roscpp/GetLoggers", "set_logger_level": "roscpp/SetLoggerLevel"}


def type_by_name(name: str) -> str:
    """The type of a service that each node of rospy and roscpp has, by its name; empty for others."""
    return _LOGGER_NAMES.get(name.rpartition("/")[2], "")


def ros1_without_use(service_type: str, *, ruled: bool = False) -> str:
    """Why ROS 2 has no use of a service of ROS 1; empty if it has.

    Args:
        service_type: ``package/Name``.
        ruled: Whether a mapping file has a rule for it, which the user wrote because there is a use.
    """
    if ruled:
        return ""
    package = service_type.partition("/")[0]
    if package == "rosapi":
        return "rosapi asks for a graph of ROS 1"
    return _ROS1_WITHOUT_USE.get(service_type, "")


def ros2_without_use(name: str, service_type: str) -> str:
    """Why ROS 1 has no use of a service of ROS 2 as a service; empty if it has.

    Args:
        name: The service's name.
        service_type: ``package/srv/Name``.
    """
    package, kind, *_ = service_type.split("/")
    if _ACTION_PART in name or kind == "action":
        return "it is a part of an action"
    return _ROS2_WITHOUT_USE.get(package, "")


class ServicePair:
    """Converts the calls of one service type.

    Args:
        ros1: The type of ROS 1.
        pair: Its counterpart.
        types: ROS 2's types; the service type is learnt from ROS 1's fields if it is not known.

    Raises:
        NoConversion: The types are no pair.
    """

    def __init__(self, ros1: ServiceType, pair: TypePair, types: Ros2Types) -> None:
        if (pair.request is not None or pair.response is not None) and pair.name not in types:
            raise NoConversion(
                f"the rule of {ros1.name} maps fields to {pair.name}, whose definition is not known here: "
                "source the ROS 2 workspace that has it"
            )
        self.ros1 = ros1
        self.ros2 = pair.name
        self.type_hash = types.service_hash(ros1, pair.name)
        """The hash in keys and tokens."""
        self.request = Conversion(ros1.request, f"{pair.name}_Request", types, pair.request)
        """Converts requests."""
        self.response = Conversion(ros1.response, f"{pair.name}_Response", types, pair.response)
        """Converts responses."""
