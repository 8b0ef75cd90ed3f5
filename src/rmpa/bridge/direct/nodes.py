"""What direct transport asks of nodes and of the kernel: where a node listens, and its connections."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.direct.conditions import Condition, Grant, Unmet
from rmpa.core.errors import RmpaError
from rmpa.core.identity import OWN_NODE
from rmpa.ros.environment import is_loopback
from rmpa.ros.http.rpc import call, call_api
from rmpa.ros.wire.slave_api import TCPROS, read_bus_info
from rmpa.ros.wire.xmlrpc import RosFault
from rmpa.runtime.kernel_tcp import connections, end_connections, listening_addresses

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from rmpa.bridge.sessions import PeerSession
    from rmpa.ros.wire.slave_api import BusLink
    from rmpa.runtime.kernel_tcp import TcpSocket

MASTER: Final = "/master"
"""The caller id of ``publisherUpdate``, as rosmaster has it."""
_STANDING: Final = frozenset({"ESTABLISHED", "SYN_SENT", "CLOSE_WAIT"})
_EVERY_ADDRESS: Final = frozenset({"0.0.0.0", "::"})  # noqa: S104 - recognised, not bound
_REMEDY: Final = "start it without ROS_IP and ROS_HOSTNAME, or with an address of the network"


# --- the slave API of subscribers ----------------------------------------------------------------------------------


async def publisher_update(uri: str, topic: str, publishers: Sequence[str]) -> bool:
    """Tell one node the publishers of a topic, as its master does; return whether it took them.

    roscpp hangs up on publishers that are not in the list. Both libraries connect to new ones.

    Args:
        uri: The node's slave API.
        topic: The topic.
        publishers: The slave APIs of the publishers.
    """
    params = (MASTER, topic, list(publishers))
    try:
        reply = await call_api(uri, "publisherUpdate", *params, timeout=limits.DIRECT_NODE_TIMEOUT)
    except (RmpaError, RosFault):
        return False
    return reply.code == 1


async def bus_links(uri: str, topic: str) -> list[BusLink] | None:
    """The connections of a subscriber for one topic; ``None`` if it does not answer."""
    try:
        value = await call(uri, "getBusInfo", OWN_NODE, timeout=limits.DIRECT_NODE_TIMEOUT)
    except (RmpaError, RosFault):
        return None
    return [one for one in read_bus_info(value) if one.inbound and one.topic == topic]


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
    while links := await bus_links(uri, topic):
        if all(one.other != publisher for one in links) or asyncio.get_running_loop().time() >= deadline:
            return
        await asyncio.sleep(limits.DIRECT_LOOK)


# --- the kernel's table --------------------------------------------------------------------------------------------


def kernel_tells() -> bool:
    """Whether the kernel lists the connections of this machine; without that, two paths cannot be ruled out."""
    return connections(remote=("127.0.0.1", 1)) is not None


def standing(address: str, port: int | None = None) -> dict[int, set[int]]:
    """The connections from this machine to one address: their local ports, by the remote port.

    One question to the kernel, whatever the number of connections.
    """
    found: dict[int, set[int]] = {}
    for one in connections(remote=(address, port)) or ():
        if one.state in _STANDING:
            found.setdefault(one.remote[1], set()).add(one.local[1])
    return found


async def end_links(endpoint: tuple[str, int], links: Iterable[BusLink]) -> str:
    """End connections of a subscriber to a publisher's address, if they still stand; wait until they are gone.

    Args:
        endpoint: The address and port; other programs may be connected there too.
        links: The connections, as the subscriber tells them.

    Returns:
        Empty if none is left, else why they could not be ended.
    """
    ports = {link.local_port for link in links if link.local_port is not None}

    def left() -> set[int]:
        return ports & standing(*endpoint).get(endpoint[1], set())

    if not left():
        return ""
    found = connections(remote=endpoint)
    problem = end_all(found and [one for one in found if one.local[1] in ports])
    loop = asyncio.get_running_loop()
    deadline = loop.time() + limits.DIRECT_MOVE_WAIT
    while left():
        if loop.time() >= deadline:
            return problem or "the kernel does not end it"
        await asyncio.sleep(limits.DIRECT_LOOK)
    return ""


def end_all(found: list[TcpSocket] | None) -> str:
    """End connections; return why it failed, or empty. ``None``: the kernel did not list them."""
    if found is None:
        return "the kernel does not say which connections there are"
    try:
        end_connections(found)
    except OSError as error:
        return error.strerror or str(error)
    return ""


# --- where this module's nodes listen ------------------------------------------------------------------------------


class NodePorts:
    """The TCPROS ports of local publishers, by their slave API: asked once at a time, and known for a while."""

    def __init__(self) -> None:
        self._ports: dict[str, asyncio.Task[int | Unmet]] = {}

    async def find(self, node: str, uri: str, topic: str) -> int | Unmet:
        """The port at which a publisher serves a topic, or why there is none.

        Args:
            node: The publishing node.
            uri: Its slave API.
            topic: The topic.
        """
        task = self._ports.get(uri)
        if task is None:
            if len(self._ports) >= limits.DIRECT_MAX:
                del self._ports[next(iter(self._ports))]
            task = self._ports[uri] = asyncio.create_task(_ask_port(node, uri, topic), name=f"port of {node}")
            asyncio.get_running_loop().call_later(limits.DIRECT_PORT_KNOWN, self.forget, uri, task)
        found = await asyncio.shield(task)
        if isinstance(found, Unmet):
            self.forget(uri, task)
        return found

    def forget(self, uri: str, task: asyncio.Task[int | Unmet] | None = None) -> None:
        """Forget a node's port: the node has ended or broken a connection. ``task``: only if this has found it."""
        if task is None or self._ports.get(uri) is task:
            self._ports.pop(uri, None)

    async def close(self) -> None:
        """Cancel the questions to nodes."""
        for task in self._ports.values():
            task.cancel()
        await asyncio.gather(*self._ports.values(), return_exceptions=True)


async def _ask_port(node: str, uri: str, topic: str) -> int | Unmet:
    try:
        params = (OWN_NODE, topic, [[TCPROS]])
        code, status, value = await call_api(uri, "requestTopic", *params, timeout=limits.DIRECT_NODE_TIMEOUT)
    except (RmpaError, RosFault) as error:
        return Unmet(Condition.NODE, f"{node} does not answer its agent: {error}")
    port = value[2] if isinstance(value, list) and len(value) == 3 and value[0] == TCPROS else None
    if code != 1 or not isinstance(port, int) or isinstance(port, bool) or not 0 < port < 1 << 16:
        return Unmet(Condition.NODE, f"{node} offers no TCPROS for {topic}: {str(status)[:200]}")
    return port


def grant_at(session: PeerSession, node: str, port: int, probe: str) -> Grant | Unmet:
    """Grant a peer a node's port, if by the kernel's table its listening socket can be reached from the peer."""
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
