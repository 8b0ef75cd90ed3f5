"""The TCPROS endpoints of this module's nodes: at which port a node listens, and which peers reach it."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.direct.conditions import Condition, Grant, Unmet
from rmpa.bridge.policy import OWN_NODE
from rmpa.core.errors import RmpaError
from rmpa.ros.environment import is_loopback
from rmpa.ros.http.rpc import call_api
from rmpa.ros.wire.slave_api import TCPROS
from rmpa.ros.wire.tcpros import parse_service_uri
from rmpa.ros.wire.xmlrpc import RosFault
from rmpa.runtime.tcp_connections import listening_addresses

if TYPE_CHECKING:
    from rmpa.bridge.session.peer_session import PeerSession
    from rmpa.ros.core.api import Core

_EVERY_ADDRESS: Final = frozenset({"0.0.0.0", "::"})  # noqa: S104 - recognised, not bound
_REMEDY: Final = "start it without ROS_IP and ROS_HOSTNAME, or with an address of the network"


@dataclass(frozen=True, slots=True)
class _Known:
    """A node's port, and when it was asked for it (monotonic seconds)."""

    port: int
    at: float


class LocalEndpoints:
    """Finds the ports of local nodes for peers.

    Args:
        core: The local core.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self._ports: dict[str, _Known] = {}
        self._asking: dict[str, asyncio.Task[int | Unmet]] = {}

    async def of_topic(self, session: PeerSession, node: str, uri: str, topic: str) -> Grant | Unmet:
        """The port at which a publisher serves a topic, if a peer may reach it.

        Args:
            session: The peer.
            node: The publishing node.
            uri: Its slave API.
            topic: The topic.
        """
        port = await self._port(node, uri, topic)
        return port if isinstance(port, Unmet) else self._judge(session, node, port, self._probe_service(node))

    def of_service(self, session: PeerSession, node: str, uri: str, service: str) -> Grant | Unmet:
        """The port at which a service is served, if a peer may reach it.

        Args:
            session: The peer.
            node: The node that provides it.
            uri: Its registered URI, ``rosrpc://host:port``.
            service: The service.
        """
        try:
            _, port = parse_service_uri(uri)
        except RmpaError:
            return Unmet(Condition.NODE, f"{node} registered {uri[:100]!r} for {service}")
        return self._judge(session, node, port, service)

    def forget(self, uri: str) -> None:
        """Forget a node's port: the node has ended or broken a connection."""
        self._ports.pop(uri, None)

    async def close(self) -> None:
        """Cancel the questions to nodes."""
        tasks = list(self._asking.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _judge(self, session: PeerSession, node: str, port: int, probe: str) -> Grant | Unmet:
        """Checks by the kernel's table that the port's listening socket can be reached from the peer."""
        addresses = listening_addresses(port)
        if addresses is None:
            return Unmet(Condition.LISTENING, "the kernel does not say where its node listens")
        if not addresses:
            return Unmet(Condition.LISTENING, f"{node} does not listen on this module's machine (port {port})")
        if addresses & _EVERY_ADDRESS or session.own_address in addresses:
            return Grant(port, node, probe)
        if all(is_loopback(address) for address in addresses):
            return Unmet(Condition.LISTENING, f"{node} listens on loopback only: {_REMEDY}")
        text = f"{node} listens at {', '.join(sorted(addresses))}, not at {session.own_address}"
        return Unmet(Condition.LISTENING, text)

    def _probe_service(self, node: str) -> str:
        """A service of a node: rospy and roscpp nodes have their logger services."""
        name = f"{node}/get_loggers"
        return name if node in self._core.state().services.get(name, ()) else ""

    async def _port(self, node: str, uri: str, topic: str) -> int | Unmet:
        """A node's TCPROS port; several questions at a time to one node become one."""
        now = asyncio.get_running_loop().time()
        known = self._ports.get(uri)
        if known is not None and now - known.at < limits.DIRECT_PORT_KNOWN:
            return known.port
        task = self._asking.get(uri)
        if task is None:
            task = self._asking[uri] = asyncio.create_task(self._ask(node, uri, topic), name=f"port of {node}")
            task.add_done_callback(lambda _: self._asking.pop(uri, None))
        return await asyncio.shield(task)

    async def _ask(self, node: str, uri: str, topic: str) -> int | Unmet:
        try:
            params = (OWN_NODE, topic, [[TCPROS]])
            code, status, value = await call_api(uri, "requestTopic", *params, timeout=limits.DIRECT_NODE_TIMEOUT)
        except (RmpaError, RosFault) as error:
            return Unmet(Condition.NODE, f"{node} does not answer its agent: {error}")
        port = value[2] if isinstance(value, list) and len(value) == 3 and value[0] == TCPROS else None
        if code != 1 or not isinstance(port, int) or isinstance(port, bool) or not 0 < port < 1 << 16:
            return Unmet(Condition.NODE, f"{node} offers no TCPROS for {topic}: {str(status)[:200]}")
        if len(self._ports) >= limits.DIRECT_MAX:
            self._ports.clear()
        self._ports[uri] = _Known(port, asyncio.get_running_loop().time())
        return port
