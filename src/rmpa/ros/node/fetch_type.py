"""Fetches the definition of a message type from a node that publishes it: each publisher sends it in its header.

The connection ends after the header and is not registered at the master. A lazy publisher, which works only while it
has a subscriber, sees one for a moment. A connection to a peer's publisher goes through its proxy, and so opens the
route of that publisher.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import RmpaError
from rmpa.core.identity import is_own
from rmpa.ros import limits
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.ask import ask_publisher
from rmpa.ros.types.definitions import UnknownTypeError
from rmpa.ros.types.find import find_message_type, type_of_header
from rmpa.ros.wire.tcpros import printable

if TYPE_CHECKING:
    from rmpa.ros.types.messages import MessageType

_log = logging.getLogger(__name__)

# Time-out for the header of one such publisher; a peer's publisher answers when its route is open.
FETCH_TYPE_TIMEOUT: Final = 3.0


async def fetch_type(
    master_uri: str, caller_id: str, name: str, *, topic: str = "", elsewhere: bool = True
) -> tuple[MessageType, str, str] | None:
    """Ask up to ``limits.FETCH_TYPE_PUBLISHERS`` publishers of a type for its definition, one after the other.

    Args:
        master_uri: The master that knows them.
        caller_id: The name of the node that asks; it need not be registered.
        name: The type, ``package/Name``.
        topic: Its publishers are asked first.
        elsewhere: Whether publishers of other topics are asked, too, after those of ``topic``.

    Returns:
        The type, and the topic and the name of its publisher; ``None`` where no publisher of that type sent a
        definition.

    Raises:
        UnreachableError: The master does not answer.
    """
    candidates = await _publishers(master_uri, caller_id, name)
    if not elsewhere:
        candidates = [each for each in candidates if each[0] == topic]
    candidates.sort(key=lambda each: (each[0] != topic, is_own(each[1]), each))
    for where, node in candidates[: limits.FETCH_TYPE_PUBLISHERS]:
        if node == caller_id:
            continue
        try:
            async with asyncio.timeout(FETCH_TYPE_TIMEOUT):
                uri = str((await call_api(master_uri, "lookupNode", caller_id, node)).value)
                header = await ask_publisher(uri, where, f"{caller_id}_learns")
            if header.get("type") == name:
                return await asyncio.to_thread(type_of_header, header), where, node
        except (RmpaError, OSError) as error:
            _log.debug("! %s from %s: %s", name, node, printable(str(error)))
    return None


async def find_here(name: str) -> MessageType | None:
    """Find a message type on this machine; ``None`` if only a publisher can supply it.

    Raises:
        DefinitionError: The definition is malformed, or rmpa brings the types of its package, but none of this name.
    """
    try:
        return await asyncio.to_thread(find_message_type, name)
    except UnknownTypeError as error:
        if not error.fetchable:
            raise
        return None


async def find_or_fetch(master_uri: str, caller_id: str, name: str, topic: str = "") -> MessageType:
    """Find a message type on this machine (``ros.types.find``), else fetch it from a publisher.

    Args:
        master_uri: The master whose publishers are asked.
        caller_id: The node that asks.
        name: The type, ``package/Name``.
        topic: Its publishers are asked first.

    Raises:
        UnknownTypeError: Neither this machine nor a publisher has it.
        DefinitionError: The definition on this machine is malformed.
        UnreachableError: The master does not answer.
    """
    try:
        return await asyncio.to_thread(find_message_type, name)
    except UnknownTypeError as error:
        if not error.fetchable:
            raise
        learnt = await fetch_type(master_uri, caller_id, name, topic=topic)
        if learnt is None:
            error.problem += f"; no publisher at {master_uri} tells it"
            raise
    kind, where, node = learnt
    _log.info("= %s is learnt from %s, which publishes %s", name, printable(node), printable(where))
    return kind


async def _publishers(master_uri: str, caller_id: str, name: str) -> list[tuple[str, str]]:
    """(topic, node) pairs of all publishers of a type."""
    state = (await call_api(master_uri, "getSystemState", caller_id)).value
    types = (await call_api(master_uri, "getTopicTypes", caller_id)).value
    try:
        publishers = msgspec.convert(state, list[list[tuple[str, list[str]]]])[0]
        topics = {topic for topic, kind in msgspec.convert(types, list[tuple[str, str]]) if kind == name}
    except (msgspec.ValidationError, IndexError):  # a master that does not answer as one does
        return []
    return [(topic, node) for topic, nodes in publishers if topic in topics for node in nodes]
