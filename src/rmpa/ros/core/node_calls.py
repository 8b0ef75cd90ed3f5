"""Calls to one node's slave API: ping and shut down."""

from __future__ import annotations

import asyncio
from itertools import islice
from typing import TYPE_CHECKING

from rmpa.core.errors import PeerRefused, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.core.liveness import refuses
from rmpa.ros.http.client import call, call_api
from rmpa.ros.node_info import NodeConnection, NodePing
from rmpa.ros.wire.bus import read_bus_info
from rmpa.ros.wire.xmlrpc import RosFault, RosReply

if TYPE_CHECKING:
    from collections.abc import Mapping


async def ping_node(node: str, uri: str, caller_id: str) -> NodePing:
    """Ask a node for its process id, and measure the time of the call.

    Args:
        node: Its name, for errors.
        uri: Its slave API.
        caller_id: The asking node's name.

    Raises:
        UnreachableError: The node does not answer.
        PeerRefused: The node answers with an error.
        RemoteProtocolError: The answer is malformed.
    """
    loop = asyncio.get_running_loop()
    begin = loop.time()
    reply = await _call(node, uri, "getPid", caller_id)
    if reply.code != 1 or not isinstance(reply.value, int):
        raise PeerRefused(node, reply.status or "it does not tell its process")
    return NodePing(uri=uri, time=loop.time() - begin, pid=reply.value)


async def node_connections(uri: str, caller_id: str, names: Mapping[str, str]) -> tuple[NodeConnection, ...] | None:
    """Ask a node for its connections; ``None`` if it does not answer.

    Args:
        uri: Its slave API.
        caller_id: The asking node's name.
        names: Nodes by their slave APIs: of a publisher a subscriber knows that address alone.
    """
    try:
        links = read_bus_info(await call(uri, "getBusInfo", caller_id))
    except (RmpaError, RosFault):
        return None
    found = (
        NodeConnection(
            topic=link.topic, inbound=link.inbound, other=names.get(link.other, link.other), connected=link.connected
        )
        for link in links
    )
    return tuple(islice(found, limits.NODE_CONNECTIONS_SHOWN))


async def end_node(node: str, uri: str, caller_id: str, reason: str) -> bool:
    """Ask a node to end, and wait up to ``limits.NODE_KILL_WAIT`` until it has.

    Args:
        node: Its name, for errors.
        uri: Its slave API.
        caller_id: The asking node's name.
        reason: For the node's log.

    Returns:
        Whether nothing listens at its slave API any more.

    Raises:
        UnreachableError: The node does not answer, and its port does not refuse connections.
        PeerRefused: The node refuses.
        RemoteProtocolError: The answer is malformed.
    """
    try:
        reply = await _call(node, uri, "shutdown", caller_id, reason)
    except (UnreachableError, RemoteProtocolError):
        # A node may end before it answers.
        if not await refuses(uri):
            raise
        return True
    if reply.code != 1:
        raise PeerRefused(node, reply.status or "it does not end")
    return await _ended(uri)


async def _ended(uri: str) -> bool:
    loop = asyncio.get_running_loop()
    give_up = loop.time() + limits.NODE_KILL_WAIT
    while not await refuses(uri):
        if loop.time() >= give_up:
            return False
        await asyncio.sleep(limits.NODE_KILL_LOOK)
    return True


async def _call(node: str, uri: str, method: str, *params: str) -> RosReply:
    try:
        return await call_api(uri, method, *params)
    except RosFault as error:
        raise PeerRefused(node, error.text) from error
