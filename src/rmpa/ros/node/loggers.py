"""The loggers of a node, asked and set by its two services, as rqt_logger_level does (wiki.ros.org/rosconsole)."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import ConfigError, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.ros.node.service_client import ServiceConnection
from rmpa.ros.node.slave_node import GET, SET, pack_text, read_texts
from rmpa.ros.wire.tcpros import LENGTH

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.ros.wire.tcpros import Buffer

LEVELS: Final = ("debug", "info", "warn", "error", "fatal")
# Loggers of one node that are read.
_LOGGERS_MAX: Final = 1000
# Seconds that a node has to answer.
_TIMEOUT: Final = 3.0
# The loggers above all that the user's own code logs to: of rospy, of roscpp, of an agent.
_ROOTS: Final = ("rosout", "ros", "rmpa")


async def node_loggers(uri: str, node: str, caller: str, logger: str = "", level: str = "") -> dict[str, str]:
    """The levels of a node's loggers by name; with ``level``, after one of them was set.

    Args:
        uri: The ``rosrpc://`` URI of the node's services.
        node: Its name.
        caller: The calling node.
        logger: The logger to set; empty: that of the node's own code.
        level: One of ``LEVELS``; empty: nothing is set.

    Raises:
        ConfigError: There is no such level or logger.
        RmpaError: The node does not answer, or refuses.
    """
    if level and level not in LEVELS:
        raise ConfigError("level", f"{level[:40]!r} is not a level", f"use one of {', '.join(LEVELS)}")
    try:
        async with asyncio.timeout(_TIMEOUT):
            levels = _read(await _call(uri, f"{node}/get_loggers", caller, GET.md5sum, b""))
            if not level:
                return levels
            wanted = logger or own_logger(levels)
            if wanted not in levels:
                known = ", ".join(levels) or "none"
                raise ConfigError("logger", f"{node} has no logger {wanted[:80]!r}", f"it has: {known}")
            await _call(uri, f"{node}/set_logger_level", caller, SET.md5sum, pack_text(wanted) + pack_text(level))
            return _read(await _call(uri, f"{node}/get_loggers", caller, GET.md5sum, b""))
    except TimeoutError:
        raise UnreachableError("server of service", f"{node}/get_loggers within {_TIMEOUT:g} s") from None


def own_logger(levels: Mapping[str, str]) -> str:
    """The logger to which the node's own code logs, or which is above that; empty where it cannot be told."""
    return next((name for name in _ROOTS if name in levels), "")


async def _call(uri: str, service: str, caller: str, md5sum: str, request: bytes) -> bytes | bytearray:
    connection = await ServiceConnection.open(uri, service, caller, md5sum=md5sum, persistent=False)
    try:
        done, body = await connection.call(request)
    finally:
        connection.close()
    if not done:
        raise RmpaError(f"{service} failed: {str(body, 'utf-8', 'replace')[:400]}", code="service-failed")
    return body


def _read(body: Buffer) -> dict[str, str]:
    """The loggers of a roscpp/GetLoggersResponse, and their levels."""
    what = "roscpp/GetLoggersResponse"
    count = LENGTH.unpack_from(body)[0] if len(body) >= LENGTH.size else _LOGGERS_MAX + 1
    if count > _LOGGERS_MAX:
        raise RemoteProtocolError(f"{len(body)} bytes are not a {what} of at most {_LOGGERS_MAX} loggers")
    texts = read_texts(memoryview(body)[LENGTH.size :], 2 * count, what)
    return {name[:256]: level[:16].lower() for name, level in zip(texts[::2], texts[1::2], strict=True)}
