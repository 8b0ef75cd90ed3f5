"""The ROS 1 side: master, parameter server, slave API, TCPROS and message types.

Users' programs import ``Node`` and the other classes in ``__all__`` from here. Each is imported when it is first
used, so that the agent starts without numpy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from rmpa.ros.environment import RosEnvironment
    from rmpa.ros.node.node import Node, Publisher, Received, Service, ServiceClient, Subscriber
    from rmpa.ros.types.installed import ServiceType
    from rmpa.ros.types.messages import MessageType

__all__ = [
    "MessageType",
    "Node",
    "Publisher",
    "Received",
    "RosEnvironment",
    "Service",
    "ServiceClient",
    "ServiceType",
    "Subscriber",
]

_MODULES: Final = {
    "MessageType": "rmpa.ros.types.messages",
    "RosEnvironment": "rmpa.ros.environment",
    "ServiceType": "rmpa.ros.types.installed",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULES.get(name, "rmpa.ros.node.node")), name)
