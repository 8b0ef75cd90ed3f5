"""The node ``/rosout``: what every node logs, joined on ``/rosout_agg`` (wiki.ros.org/rosout).

The messages are passed on as they come, never decoded.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

from rmpa.core import limits
from rmpa.ros.aio.logger_services import LoggerServices
from rmpa.ros.aio.publication import Publication
from rmpa.ros.aio.slave_server import SlaveNode
from rmpa.ros.aio.subscription import PublisherConnection, Subscription
from rmpa.ros.std_header import HEADER_PART
from rmpa.ros.tcpros import Description

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.counters import Counters
    from rmpa.ros.xmlrpc import Reply, XmlRpcValue

_log = logging.getLogger(__name__)

NODE: Final = "/rosout"
TOPIC: Final = "/rosout"
AGGREGATED: Final = "/rosout_agg"
_LOGGERS: Final = {"ros": "rmpa.ros", "ros.rosout": "rmpa.ros.aio.rosout"}
"""By the names that a roscore's rosout has for the like."""
LOG_TYPE: Final = "rosgraph_msgs/Log"
LOG_MD5: Final = "acffd30cd6b6de30f120938c17c593fb"
_DEFINITION: Final = (
    "##\n"
    "## Severity level constants\n"
    "##\n"
    "byte DEBUG=1 #debug level\n"
    "byte INFO=2  #general level\n"
    "byte WARN=4  #warning level\n"
    "byte ERROR=8 #error level\n"
    "byte FATAL=16 #fatal/critical level\n"
    "##\n"
    "## Fields\n"
    "##\n"
    "Header header\n"
    "byte level\n"
    "string name # name of the node\n"
    "string msg # message \n"
    "string file # file the message came from\n"
    "string function # function the message came from\n"
    "uint32 line # line the message came from\n"
    "string[] topics # topic names that the node publishes\n"
    "\n"
    f"{HEADER_PART}"
)
"""As ROS's own publishers send it: rosbag and others compute the md5 sum from it."""


class Rosout:
    """The aggregator, a node of its own in the graph, as users and tools expect it.

    Args:
        host: The address to listen at.
        advertised_host: What nodes are told to connect to.
        master_uri: The core's URI.
        call: The core's own API.
        counters: Where refusals are counted.
    """

    def __init__(
        self,
        host: str,
        advertised_host: str,
        master_uri: str,
        call: Callable[..., Reply],
        counters: Counters,
    ) -> None:
        self._call = call
        self._node = SlaveNode(
            NODE,
            host,
            master_uri,
            advertised_host=advertised_host,
            counters=counters,
            on_shutdown=self._replaced,
        )
        self._aggregated = Publication(
            AGGREGATED,
            NODE,
            Description(LOG_TYPE, LOG_MD5, _DEFINITION),
            queue_messages=limits.ROSOUT_QUEUE,
        )
        self._subscription: Subscription | None = None
        self._loggers = LoggerServices(self._node, call, _LOGGERS)

    @property
    def uri(self) -> str:
        """The node's slave API."""
        return self._node.uri

    async def start(self) -> None:
        """Listen and register.

        Raises:
            StartError: The address cannot be used.
        """
        await self._node.start()
        self._node.add_publication(self._aggregated)
        self._subscription = Subscription(
            TOPIC,
            NODE,
            on_message=self._pass_on,
            on_refused=self._refused,
            own_uri=self._node.uri,
            type_name=LOG_TYPE,
            md5sum=LOG_MD5,
            definition=_DEFINITION,
            number=self._node.next_number,
        )
        self._node.add_subscription(self._subscription)
        self._call("registerPublisher", NODE, AGGREGATED, LOG_TYPE, self._node.uri)
        reply = self._call("registerSubscriber", NODE, TOPIC, LOG_TYPE, self._node.uri)
        self._subscription.update(_texts(reply.value))
        self._loggers.start()

    async def close(self) -> None:
        """Unregister and close."""
        self._loggers.close()
        self._call("unregisterSubscriber", NODE, TOPIC, self._node.uri)
        self._call("unregisterPublisher", NODE, AGGREGATED, self._node.uri)
        await self._node.close()

    def _pass_on(self, _publisher: PublisherConnection, framed: memoryview) -> None:
        self._aggregated.publish_framed(framed)

    def _refused(self, publisher: PublisherConnection, text: str) -> None:
        _log.info("! %s of %s is not aggregated: %s", TOPIC, publisher.uri, text)

    def _replaced(self, _reason: str) -> None:
        """Another /rosout took over: ours stays up, unregistered, and passes nothing on."""
        _log.info("= another node aggregates %s now", TOPIC)
        if self._subscription is not None:
            self._subscription.update([])


def _texts(value: XmlRpcValue) -> list[str]:
    return [uri for uri in value if isinstance(uri, str)] if isinstance(value, list) else []
