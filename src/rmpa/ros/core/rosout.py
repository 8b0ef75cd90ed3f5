"""The node ``/rosout``: forwards the log messages of all nodes to ``/rosout_agg`` (wiki.ros.org/rosout).

The messages are never decoded.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RmpaError
from rmpa.ros import limits
from rmpa.ros.master.effects import RegistrationKind
from rmpa.ros.node.logger_services import LoggerServices
from rmpa.ros.node.publication import Publication
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.node.subscription import PublisherConnection, Subscription
from rmpa.ros.types.std_header import HEADER_PART
from rmpa.ros.wire.tcpros import TopicDescription

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.core.counters import Counters
    from rmpa.ros.master.effects import GraphChange
    from rmpa.ros.master.registrations import Registrations
    from rmpa.ros.wire.xmlrpc import RosReply, XmlRpcValue

_log = logging.getLogger(__name__)

NODE: Final = "/rosout"
TOPIC: Final = "/rosout"
AGGREGATED: Final = "/rosout_agg"
_LOGGERS: Final = {"ros": "rmpa.ros", "ros.rosout": "rmpa.ros.core.rosout"}
"""Python's loggers, by the names that the rosout of a roscore gives to its own."""
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
"""The text that ROS's own publishers send: rosbag and others compute the md5 sum from it."""


class Rosout:
    """Keeps the node ``/rosout`` in the graph, as users and tools expect it.

    Like roscore it restarts the node when that ends (``rosnode kill /rosout``), at a new address, after
    ``limits.ROSOUT_RESPAWN`` seconds. While another node has the name, this one does not run.

    Args:
        host: The address to listen at.
        advertised_host: The address that is registered.
        master_uri: The core's URI.
        call: Calls the core's master.
        registrations: The core's tables, which show what node has the name.
        counters: Count refusals, and ``rosout.restarted``.
    """

    def __init__(
        self,
        host: str,
        advertised_host: str,
        master_uri: str,
        call: Callable[..., RosReply],
        registrations: Registrations,
        counters: Counters,
    ) -> None:
        self._host = host
        self._advertised = advertised_host
        self._master_uri = master_uri
        self._call = call
        self._registrations = registrations
        self._counters = counters
        self._aggregator: _Aggregator | None = None
        self._keeper: asyncio.Task[None] | None = None
        self._asked_to_end = False
        self._changed = asyncio.Event()

    @property
    def uri(self) -> str:
        """The node's slave API; empty while it does not run."""
        return self._aggregator.uri if self._aggregator is not None else ""

    async def start(self) -> None:
        """Listen, register, and stay registered.

        Raises:
            StartError: The address cannot be used.
        """
        await self._begin()
        self._keeper = asyncio.create_task(self._keep(), name="keep /rosout")

    async def close(self) -> None:
        """Unregister and close."""
        if self._keeper is not None:
            self._keeper.cancel()
            await asyncio.gather(self._keeper, return_exceptions=True)
        await self._end()

    def graph_changed(self, change: GraphChange) -> None:
        """Note a change in the graph: the name may be free now, or taken."""
        if change.node == NODE and not change.added:
            self._changed.set()

    async def _begin(self) -> None:
        self._asked_to_end = False
        aggregator = _Aggregator(
            SlaveNode(
                NODE,
                self._host,
                self._master_uri,
                advertised_host=self._advertised,
                counters=self._counters,
                on_shutdown=self._killed,
            ),
            self._call,
        )
        await aggregator.start()
        self._aggregator = aggregator

    async def _end(self) -> None:
        aggregator, self._aggregator = self._aggregator, None
        if aggregator is not None:
            await aggregator.close()

    def _killed(self, reason: str) -> None:
        _log.info("= %s was asked to end (%s)", NODE, reason)
        self._asked_to_end = True
        self._changed.set()

    async def _keep(self) -> None:
        while True:
            await self._changed.wait()
            self._changed.clear()
            if self._asked_to_end or not self._is_registered():
                await self._end()
                await asyncio.sleep(limits.ROSOUT_RESPAWN)
                await self._restart()

    def _is_registered(self) -> bool:
        """Whether both registrations of the aggregator are in the graph."""
        at = self._registrations.at
        publisher, subscriber = at(RegistrationKind.PUBLISHER, AGGREGATED), at(RegistrationKind.SUBSCRIBER, TOPIC)
        return publisher.get(NODE) == subscriber.get(NODE) == self.uri

    async def _restart(self) -> None:
        told = False
        while self._aggregator is None:
            if (holder := self._registrations.node_api(NODE)) is not None:
                if not told:
                    _log.warning("= another node is %s now, at %s; ours waits until it leaves", NODE, holder)
                    told = True
                with contextlib.suppress(TimeoutError):
                    # The end of a node that only subscribed to parameters is not reported, so it is polled for.
                    async with asyncio.timeout(limits.ROSOUT_LOOK):
                        await self._changed.wait()
                self._changed.clear()
                continue
            try:
                await self._begin()
            except (RmpaError, OSError) as error:
                _log.error("! %s cannot be started again yet: %s", NODE, error)
                await asyncio.sleep(limits.ROSOUT_LOOK)
        self._counters.add("rosout.restarted")
        _log.info("= %s is back at %s", NODE, self.uri)


class _Aggregator:
    """One run of the node, from its registration to its end.

    Args:
        node: Not started yet.
        call: Calls the core's master.
    """

    def __init__(self, node: SlaveNode, call: Callable[..., RosReply]) -> None:
        self._call = call
        self._node = node
        self._aggregated = Publication(
            AGGREGATED,
            NODE,
            TopicDescription(LOG_TYPE, LOG_MD5, _DEFINITION),
            queue_messages=limits.ROSOUT_QUEUE,
        )
        self._loggers = LoggerServices(node, call, _LOGGERS)

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
        subscription = Subscription(
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
        self._node.add_subscription(subscription)
        self._call("registerPublisher", NODE, AGGREGATED, LOG_TYPE, self._node.uri)
        reply = self._call("registerSubscriber", NODE, TOPIC, LOG_TYPE, self._node.uri)
        subscription.update(_texts(reply.value))
        self._loggers.start()

    async def close(self) -> None:
        """Unregister, and close."""
        self._loggers.close()
        self._call("unregisterSubscriber", NODE, TOPIC, self._node.uri)
        self._call("unregisterPublisher", NODE, AGGREGATED, self._node.uri)
        await self._node.close()

    def _pass_on(self, _publisher: PublisherConnection, framed: memoryview) -> None:
        self._aggregated.publish_framed(framed)

    def _refused(self, publisher: PublisherConnection, text: str) -> None:
        _log.info("! %s of %s is not aggregated: %s", TOPIC, publisher.uri, text)


def _texts(value: XmlRpcValue) -> list[str]:
    return [uri for uri in value if isinstance(uri, str)] if isinstance(value, list) else []
