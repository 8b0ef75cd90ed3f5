from rmpa.core.errors import ConfigError, PeerRefused, RmpaError, UnreachableError
from rmpa.ros.node.node import Node, Publisher, Received, Service, ServiceClient, Subscriber
from rmpa.ros.node.service_client import ServiceFailed
from rmpa.ros.types.definitions import DefinitionError
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageError, MessageType
from rmpa.sync import SyncNode, SyncPublisher, connect

COMMIT: str
DATE: str
VERSION: str
__version__: str

__all__ = [
    "COMMIT",
    "DATE",
    "VERSION",
    "ConfigError",
    "DefinitionError",
    "MessageError",
    "MessageType",
    "Node",
    "PeerRefused",
    "Publisher",
    "Received",
    "RmpaError",
    "Service",
    "ServiceClient",
    "ServiceFailed",
    "ServiceType",
    "Subscriber",
    "SyncNode",
    "SyncPublisher",
    "UnreachableError",
    "__version__",
    "connect",
]
