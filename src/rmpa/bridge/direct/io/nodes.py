"""Calls to local nodes that direct transport needs: their connections, and whom they shall be connected to."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rmpa.bridge import limits
from rmpa.bridge.policy import OWN_NODE
from rmpa.core.errors import RmpaError
from rmpa.ros.http.client import call, call_api
from rmpa.ros.wire.bus import read_bus_info
from rmpa.ros.wire.xmlrpc import RosFault
from rmpa.runtime.tcp_connections import connections, end_connections

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.ros.wire.bus import BusLink
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


async def direct_links(uri: str, topic: str, endpoint: tuple[str, int]) -> list[BusLink] | None:
    """The connections of a subscriber, for one topic, to a publisher's address; ``None`` if it does not answer."""
    links = await bus_links(uri)
    if links is None:
        return None
    return [one for one in links if one.inbound and one.topic == topic and one.connected and one.remote == endpoint]


def standing(endpoint: tuple[str, int]) -> set[int]:
    """The local ports of the connections from this machine to a publisher's address."""
    found = connections(remote=endpoint) or []
    return {one.local[1] for one in found if one.state in _STANDING}


def connecting(endpoint: tuple[str, int]) -> list[TcpConnection]:
    """The connections from this machine to an address that wait for its first answer."""
    return [one for one in connections(remote=endpoint) or [] if one.state == "SYN_SENT"]


def end_these(found: list[TcpConnection]) -> str:
    """End connections; return why it failed, or empty."""
    return _end(found)


def end_to(endpoint: tuple[str, int], ports: set[int] | None = None) -> str:
    """End connections from this machine to a publisher's address.

    Args:
        endpoint: The address and port.
        ports: The local ports of those to end; ``None``: all.

    Returns:
        Empty if none is left, else why they could not be ended.
    """
    found = connections(remote=endpoint)
    if found is None or ports is None:
        return _end(found)
    return _end([one for one in found if one.local[1] in ports])


def end_from(port: int, address: str) -> str:
    """End the connections of a local publisher, by its port, to a peer's address; return why it failed, or empty."""
    return _end(connections(local_port=port, remote=(address, None)))


def _end(found: list[TcpConnection] | None) -> str:
    if found is None:
        return "the kernel does not say which connections there are"
    if not found:
        return ""
    try:
        end_connections(found)
    except OSError as error:
        return error.strerror or str(error)
    return ""
