"""Calls to local nodes that direct transport needs: their connections, and lists of publishers sent to them."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.policy import OWN_NODE
from rmpa.core.errors import RmpaError
from rmpa.ros.http.rpc import call, call_api
from rmpa.ros.wire.slave_api import read_bus_info
from rmpa.ros.wire.xmlrpc import RosFault
from rmpa.runtime.tcp_connections import connections, end_connections

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from rmpa.ros.wire.slave_api import BusLink
    from rmpa.runtime.tcp_connections import TcpConnection

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
