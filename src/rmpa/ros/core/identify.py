"""Finds out which node is at an address: its port may be another node's by now (ros_comm#2018, #2241)."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.ros import limits
from rmpa.ros.http.client import call_api, connect
from rmpa.ros.node.probe import exchange_headers
from rmpa.ros.wire.tcpros import subscriber_header
from rmpa.ros.wire.xmlrpc import RosFault
from rmpa.runtime.accept import Use

if TYPE_CHECKING:
    from collections.abc import Sequence

_log = logging.getLogger(__name__)

_CALLER_ID: Final = "/rmpa_identify"
_TOPICS_ASKED: Final = 2


async def name_at(api: str, topics: Sequence[str] = ()) -> str | None:
    """Ask the node with this slave API for its name.

    rospy has ``getName``. roscpp has not, but sends its name in the header of every topic that it publishes, and
    every node publishes ``/rosout``.

    Args:
        api: The slave API's URI.
        topics: Other topics that the node may publish.

    Returns:
        Its name, or ``None`` if it cannot be found out.

    Raises:
        UnreachableError: The slave API does not answer.
    """
    try:
        reply = await call_api(api, "getName", _CALLER_ID, use=Use.CORE)
    except (RosFault, RemoteProtocolError):
        pass
    else:
        if reply.code == 1 and isinstance(reply.value, str):
            return reply.value
    for topic in dict.fromkeys(["/rosout", *topics][:_TOPICS_ASKED]):
        try:
            async with asyncio.timeout(limits.SLAVE_CALL_TIMEOUT):
                name = await _publisher_of(api, topic)
        except (RosFault, RemoteProtocolError, OSError) as error:
            _log.debug("= %s does not tell its name for %s: %s", api, topic, error)
            continue
        if name is not None:
            return name
    return None


async def _publisher_of(api: str, topic: str) -> str | None:
    reply = await call_api(api, "requestTopic", _CALLER_ID, topic, [["TCPROS"]], use=Use.CORE)
    match reply:
        case (1, _, ["TCPROS", str(host), int(port)]):
            return await _callerid(host, port, topic)
    return None


async def _callerid(host: str, port: int, topic: str) -> str | None:
    sock = await connect(host, port, Use.CORE)
    try:
        fields = await exchange_headers(sock, subscriber_header(topic, _CALLER_ID))
    finally:
        sock.close()
    return None if fields is None else fields.get("callerid")
