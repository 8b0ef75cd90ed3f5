"""What direct transport needs to know of nodes: its conditions, where a node listens, and its connections.

The conditions of direct transport: each one that fails is a reason to relay. Pure.

docs/contracts.md lists them for users.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.messages import is_crossing_name
from rmpa.core.contract import Transport, needs_agents
from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.core.identity import OWN_NODE
from rmpa.ros.environment import is_loopback
from rmpa.ros.http.rpc import call, call_api
from rmpa.ros.wire.slave_api import TCPROS, read_bus_info
from rmpa.ros.wire.tcpros import parse_service_uri
from rmpa.ros.wire.xmlrpc import RosFault
from rmpa.runtime.tcp_connections import connections, end_connections, listening_addresses

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from rmpa.bridge.policy import PermissionGate
    from rmpa.bridge.sessions import PeerSession
    from rmpa.core.contract import Contract
    from rmpa.ros.core.external import Core
    from rmpa.ros.wire.slave_api import BusLink
    from rmpa.runtime.tcp_connections import TcpConnection

_TEXT_MAX: Final = 300
"""Characters of a peer's text that are kept."""


class Condition(StrEnum):
    """A condition of direct transport; its value is the word in ``--json`` and between agents."""

    TRANSPORT = "transport"
    """The transport of the contract, or of the service's rule, is not ``relay``."""
    CONTRACT = "contract"
    """The contract asks for nothing that only agents do."""
    NAME = "name"
    """The topic or service has the same name in both modules: TCPROS headers carry it."""
    OWN_SOURCE = "own_source"
    """The source is the peer's own, and does not come by a relay."""
    ACTION = "action"
    """It is no topic whose publisher compares the names of its subscribers."""
    RELEASE = "release"
    """The peer's agent knows direct transport."""
    AGENT = "agent"
    """The peer's agent answers in time."""
    OFFERED = "offered"
    """The peer offers the topic or service now."""
    NODE = "node"
    """The publisher's node answers its agent."""
    LISTENING = "listening"
    """The publisher's node listens where the subscriber's module can reach it, not only on loopback."""
    REACHABLE = "reachable"
    """A connection from the subscriber's module to the publisher's node works."""
    CALLER_ID = "caller_id"
    """No other subscriber of the same name is connected to the publisher."""
    SUBSCRIBER = "subscriber"
    """The subscriber's node connects to other machines (ROS_IP and ROS_HOSTNAME do not bind it to loopback)."""
    MEASURES = "measures"
    """The subscriber is no tool that measures by the agents."""
    LATCHED = "latched"
    """No latched message would be delivered twice by the move."""
    STABLE = "stable"
    """Direct connections of this subscriber have not broken repeatedly."""
    LIMIT = "limit"
    """The peer's direct connections are within ``limits.DIRECT_MAX``."""
    TRUST = "trust"
    """The mesh is not secured, or both modules let plain connections cross (``trust.direct``), or share a machine."""
    CORE = "core"
    """The local core can answer each node by itself: services only."""


_PASSING: Final = frozenset({Condition.AGENT, Condition.NODE, Condition.REACHABLE, Condition.STABLE, Condition.LIMIT})


@dataclass(frozen=True, slots=True)
class Unmet:
    """A condition that does not hold, and the fact as text for the user."""

    condition: Condition
    text: str

    @property
    def lasting(self) -> bool:
        """Whether only a change that is noticed can make it hold, so that trying again by time is of no use."""
        return self.condition not in _PASSING


NO_LINK: Final = Unmet(Condition.OFFERED, "its module has no link")
"""What holds while there is no link."""


@dataclass(frozen=True, slots=True)
class Grant:
    """A peer's permission to connect to one of its nodes.

    Args:
        port: The node's TCPROS port; the address is that of the link.
        node: The node's name in the peer's graph.
        probe: A service of the node, by which it is probed; empty: none is known.
    """

    port: int
    node: str
    probe: str = ""


def read_reply(value: object, node: str) -> Grant | Unmet:
    """Read the response of a peer to ``direct.topic`` or ``direct.service``.

    Args:
        value: What the peer sent.
        node: The node that was asked for.

    Raises:
        RemoteProtocolError: It is neither a port nor a reason.
    """
    if isinstance(value, dict):
        port, probe = value.get("port"), value.get("probe", "")
        if isinstance(port, int) and not isinstance(port, bool) and 0 < port < 1 << 16 and isinstance(probe, str):
            return Grant(port, node, probe if is_crossing_name(probe) else "")
        why, text = value.get("why"), value.get("text", "")
        if isinstance(why, str) and isinstance(text, str):
            return read_unmet(why, text)
    raise RemoteProtocolError("the answer about a direct connection has neither a port nor a reason")


def read_unmet(why: str, text: str) -> Unmet:
    """Read a condition that a peer names; one of a later release counts as ``RELEASE``. The text is safe to show."""
    try:
        condition = Condition(why)
    except ValueError:
        condition = Condition.RELEASE
    return Unmet(condition, "".join(one if one.isprintable() else "�" for one in text[:_TEXT_MAX]))


def reply_of(found: Grant | Unmet) -> dict[str, object]:
    """The response to a peer's ``direct.topic`` or ``direct.service``."""
    if isinstance(found, Grant):
        return {"port": found.port, "probe": found.probe}
    return {"why": found.condition.value, "text": found.text}


def unmet_by_trust(gate: PermissionGate, where: str, *, same_machine: bool) -> Unmet | None:
    """The condition that a secured mesh does not meet, if any.

    Args:
        gate: Whether the mesh is secured, and whether plain connections are let all the same.
        where: Whose setting that is, as text.
        same_machine: Whether both modules are on one machine, so that the connection does not leave it.
    """
    if gate.plain or same_machine:
        return None
    text = f"the mesh is secured, and nothing would protect the connection; trust.direct is false in {where}"
    return Unmet(Condition.TRUST, text)


def unmet_by_contract(contract: Contract, where: str) -> Unmet | None:
    """The condition that a contract does not meet, if any.

    Args:
        contract: The contract.
        where: Whose it is, as text.
    """
    if contract.transport is Transport.RELAY:
        return Unmet(Condition.TRANSPORT, f'transport is "relay" in {where}')
    terms = needs_agents(contract)
    return Unmet(Condition.CONTRACT, f"the contract asks for what only agents do: {terms}") if terms else None


# Calls to local nodes that direct transport needs: their connections, and lists of publishers sent to them.


MASTER: Final = "/master"
"""The caller id of ``publisherUpdate``, as rosmaster has it."""
_STANDING: Final = frozenset({"ESTABLISHED", "SYN_SENT", "CLOSE_WAIT"})


async def publisher_update(uri: str, topic: str, publishers: Sequence[str]) -> bool:
    """Tell one node the publishers of a topic, as its master does; return whether it took them.

    roscpp hangs up on publishers that are not in the list. Both libraries connect to new ones.

    Args:
        uri: The node's slave API.
        topic: The topic.
        publishers: The slave APIs of the publishers.
    """
    try:
        reply = await call_api(
            uri, "publisherUpdate", MASTER, topic, list(publishers), timeout=limits.DIRECT_NODE_TIMEOUT
        )
    except (RmpaError, RosFault):
        return False
    return reply.code == 1


async def bus_links(uri: str) -> list[BusLink] | None:
    """The topic connections of a node; ``None`` if it does not answer."""
    try:
        value = await call(uri, "getBusInfo", OWN_NODE, timeout=limits.DIRECT_NODE_TIMEOUT)
    except (RmpaError, RosFault):
        return None
    return read_bus_info(value)


async def until(condition: Callable[[], bool], seconds: float) -> bool:
    """Wait until a condition holds; return whether it did within these seconds."""
    loop = asyncio.get_running_loop()
    deadline = loop.time() + seconds
    while not condition():
        if loop.time() >= deadline:
            return False
        await asyncio.sleep(limits.DIRECT_LOOK)
    return True


async def direct_links(uri: str, topic: str, endpoint: tuple[str, int]) -> list[BusLink] | None:
    """The connections of a subscriber, for one topic, to a publisher's address; ``None`` if it does not answer."""
    links = await bus_links(uri)
    if links is None:
        return None
    return [one for one in links if one.inbound and one.topic == topic and one.connected and one.remote == endpoint]


async def forgotten(uri: str, topic: str, publisher: str) -> None:
    """Wait until a subscriber has no connection to a publisher any more, by its own word.

    rospy ignores a publisher in a list while the connection that has just ended is not removed yet, which takes a
    moment, and longer on a busy machine. At most ``limits.DIRECT_MOVE_WAIT``.

    Args:
        uri: The subscriber's slave API.
        topic: The topic.
        publisher: The publisher's slave API.
    """
    deadline = asyncio.get_running_loop().time() + limits.DIRECT_MOVE_WAIT
    while links := await bus_links(uri):
        connected = any(one.inbound and one.topic == topic and one.other == publisher for one in links)
        if not connected or asyncio.get_running_loop().time() >= deadline:
            return
        await asyncio.sleep(limits.DIRECT_LOOK)


def standing_at(address: str) -> dict[int, set[int]]:
    """The connections from this machine to one address: their local ports, by the remote port.

    One question to the kernel, whatever the number of connections.
    """
    found: dict[int, set[int]] = {}
    for one in connections(remote=(address, None)) or []:
        if one.state in _STANDING:
            found.setdefault(one.remote[1], set()).add(one.local[1])
    return found


def kernel_tells() -> bool:
    """Whether the kernel lists the connections of this machine; without that, two paths cannot be ruled out."""
    return connections(remote=("127.0.0.1", 1)) is not None


def standing(endpoint: tuple[str, int]) -> set[int]:
    """The local ports of the connections from this machine to a publisher's address."""
    found = connections(remote=endpoint) or []
    return {one.local[1] for one in found if one.state in _STANDING}


def connecting(endpoint: tuple[str, int]) -> list[TcpConnection]:
    """The connections from this machine to an address that wait for its first answer."""
    return [one for one in connections(remote=endpoint) or [] if one.state == "SYN_SENT"]


def end_to(endpoint: tuple[str, int], ports: set[int] | None = None) -> str:
    """End connections from this machine to a publisher's address.

    Args:
        endpoint: The address and port.
        ports: The local ports of those to end: other programs may be connected there too. ``None``: all of them.

    Returns:
        Empty if none is left, else why they could not be ended.
    """
    found = connections(remote=endpoint)
    return end_these(None if found is None else [one for one in found if ports is None or one.local[1] in ports])


async def end_links(endpoint: tuple[str, int], links: Iterable[BusLink]) -> str:
    """End connections of a subscriber to a publisher's address, if they still stand; wait until they are gone.

    Args:
        endpoint: The address and port.
        links: As ``direct_links`` returned them.

    Returns:
        Empty if none is left, else why they could not be ended.
    """
    ports = {link.local_port for link in links if link.local_port is not None}
    if not ports & standing(endpoint):
        return ""
    problem = end_to(endpoint, ports)
    if await until(lambda: not ports & standing(endpoint), limits.DIRECT_MOVE_WAIT):
        return ""
    return problem or "the kernel does not end it"


def end_from(port: int, address: str) -> str:
    """End the connections of a local publisher, by its port, to a peer's address; return why it failed, or empty."""
    return end_these(connections(local_port=port, remote=(address, None)))


def end_these(found: list[TcpConnection] | None) -> str:
    """End connections; return why it failed, or empty."""
    if found is None:
        return "the kernel does not say which connections there are"
    if not found:
        return ""
    try:
        end_connections(found)
    except OSError as error:
        return error.strerror or str(error)
    return ""


# The TCPROS endpoints of this module's nodes: at which port a node listens, and which peers reach it.


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
