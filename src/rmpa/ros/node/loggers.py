"""The loggers of a node, asked and set by its two services, as rqt_logger_level does (wiki.ros.org/rosconsole)."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import ConfigError, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.core.identity import OWN_NODE
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.service_client import ServiceConnection
from rmpa.ros.node.slave_node import GET, LEVELS, SET, pack_text, read_texts
from rmpa.ros.wire.tcpros import LENGTH

if TYPE_CHECKING:
    from rmpa.ros.wire.tcpros import Buffer

# Loggers of one node that are read.
_LOGGERS_MAX: Final = 1000
# Seconds that a node has to answer.
_TIMEOUT: Final = 3.0
# The loggers that the node's own code logs to, or that are above these: of rospy, and of roscpp. Each library takes
# the other's name without effect.
_OWN: Final = ("rosout", "ros")
# roscpp's get_loggers frees what it must not where log4cxx is newer than that of ROS (0.10, libraries .so.10), as in
# Debian 12: the node crashes at the next use of its loggers (trap 43).
_LOG4CXX: Final = re.compile(r"liblog4cxx\.so\.(\d+)")
_LOG4CXX_SAFE: Final = 10


async def read_levels(uri: str, api: str, node: str, caller: str) -> dict[str, str]:
    """The levels of a node's loggers, by name.

    Args:
        uri: The ``rosrpc://`` URI of the node's services.
        api: Its slave API.
        node: Its name.
        caller: The calling node.

    Raises:
        RmpaError: The node does not answer, or would not outlive the question.
    """
    if await _would_crash(api, caller):
        raise RmpaError(
            f"{node} is not asked: this roscpp, built with a newer log4cxx, crashes when it lists its loggers; "
            "their levels can be set",
            code="service-failed",
        )
    return _read(await _call(uri, f"{node}/get_loggers", caller, GET.md5sum, b""))


async def set_level(uri: str, node: str, caller: str, logger: str, level: str) -> dict[str, str]:
    """Set the level of one of a node's loggers; return the loggers that were set, with it.

    Args:
        uri: As for ``read_levels``.
        node: Likewise.
        caller: Likewise.
        logger: Its name, which the node may not have yet; empty: those of the node's own code.
        level: One of ``LEVELS``.

    Raises:
        ConfigError: There is no such level.
        RmpaError: The node does not answer, or refuses.
    """
    if level not in LEVELS:
        raise ConfigError("level", f"{level[:40]!r} is not a level", f"use one of {', '.join(LEVELS)}")
    wanted = (logger,) if logger else ("rmpa",) if node == OWN_NODE else _OWN
    for each in wanted:
        await _call(uri, f"{node}/set_logger_level", caller, SET.md5sum, pack_text(each) + pack_text(level))
    return dict.fromkeys(wanted, level)


async def _would_crash(api: str, caller: str) -> bool:
    """Whether the node is one that does not outlive ``get_loggers``, as far as its process can be seen."""
    try:
        reply = await call_api(api, "getPid", caller, timeout=_TIMEOUT)
        maps = await asyncio.to_thread(Path(f"/proc/{int(str(reply.value))}/maps").read_text)
    except (RmpaError, OSError, ValueError):
        return False
    return any(int(found[1]) > _LOG4CXX_SAFE for found in _LOG4CXX.finditer(maps))


async def _call(uri: str, service: str, caller: str, md5sum: str, request: bytes) -> bytes | bytearray:
    try:
        async with asyncio.timeout(_TIMEOUT):
            connection = await ServiceConnection.open(uri, service, caller, md5sum=md5sum, persistent=False)
            try:
                done, body = await connection.call(request)
            finally:
                connection.close()
    except TimeoutError:
        raise UnreachableError("server of service", f"{service} within {_TIMEOUT:g} s") from None
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
