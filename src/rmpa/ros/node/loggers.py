"""The loggers of a node: its two services, as every roscpp and rospy node has them, served and called.

With ``get_loggers`` and ``set_logger_level`` rqt_logger_level and ``rosservice
call /rmpa/set_logger_level rmpa.mesh debug`` set the levels of a program's log while it runs
(wiki.ros.org/rosconsole). The messages (roscpp/GetLoggers, roscpp/SetLoggerLevel) are serialized by hand, because the
agent starts without the types' definitions.
"""

from __future__ import annotations

import asyncio
import logging
import re
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import ConfigError, RemoteProtocolError, RmpaError, UnreachableError
from rmpa.core.identity import OWN_NODE
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.service_client import ServiceConnection
from rmpa.ros.node.service_server import ServiceCall, ServiceEndpoint
from rmpa.ros.wire.tcpros import LENGTH, Buffer, ServiceDescription, pack_text, printable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.ros.wire.xmlrpc import RosReply

_log = logging.getLogger(__name__)

GET: Final = ServiceDescription("roscpp/GetLoggers", "32e97e85527d4678a8f9279894bb64b0")
SET: Final = ServiceDescription("roscpp/SetLoggerLevel", "51da076440d78ca1684d36c868df61ea")
LEVELS: Final = {
    "debug": logging.DEBUG,
    "info": logging.INFO,
    "warn": logging.WARNING,
    "error": logging.ERROR,
    "fatal": logging.CRITICAL,
}
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


def level_of(number: int) -> int:
    """The highest of ``LEVELS``, from 0 on, that is not above a level of Python's."""
    return max(0, sum(level <= number for level in LEVELS.values()) - 1)


def serve_loggers(node: SlaveNode, call: Callable[..., RosReply], loggers: Mapping[str, str]) -> Callable[[], None]:
    """Serve the two services of a node's loggers, and register them; the node listens already.

    Args:
        node: Serves them, until it is closed.
        call: Calls the core's master.
        loggers: The name of Python's logger, by the name that the services show.

    Returns:
        A function that unregisters them.
    """
    served = {f"{node.name}/get_loggers": (_get, GET), f"{node.name}/set_logger_level": (_set, SET)}
    for service, (serve, description) in served.items():
        node.add_service(ServiceEndpoint(service, node.name, partial(serve, loggers), description=description))
        code, text, _ = call("registerService", node.name, service, node.service_uri, node.uri)
        if code != 1:
            _log.error("! the ROS core does not accept %s: %s [core-refuses]", service, text)

    def end() -> None:
        for service in served:
            call("unregisterService", node.name, service, node.service_uri)

    return end


def _get(loggers: Mapping[str, str], call: ServiceCall) -> None:
    parts = [LENGTH.pack(len(loggers))]
    for name, logger in loggers.items():
        level = level_of(logging.getLogger(logger).getEffectiveLevel())
        parts += [pack_text(name), pack_text(list(LEVELS)[level])]
    call.reply(True, b"".join(parts))


def _set(loggers: Mapping[str, str], call: ServiceCall) -> None:
    name, level = _texts(call.request, 2, "roscpp/SetLoggerLevelRequest")
    logger, number = loggers.get(name), LEVELS.get(level.lower())
    if logger is None:
        node = call.service.rpartition("/")[0]
        call.fail(f"{node} has no logger {printable(name)!r}; it has {', '.join(loggers)}")
    elif number is None:
        call.fail(f"{printable(level)!r} is not a level; there are {', '.join(LEVELS)}")
    else:
        _log.info("= %s sets the level of %s to %s", printable(call.caller_id), name, level.lower())
        logging.getLogger(logger).setLevel(number)
        call.reply(True, b"")


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
    texts = _texts(memoryview(body)[LENGTH.size :], 2 * count, what)
    return {name[:256]: level[:16].lower() for name, level in zip(texts[::2], texts[1::2], strict=True)}


def _texts(raw: Buffer, count: int, what: str) -> list[str]:
    """The strings of a message ``what`` that has so many, and nothing else.

    Raises:
        RemoteProtocolError: It is none.
    """
    found: list[str] = []
    at = 0
    while len(found) < count and at + LENGTH.size <= len(raw):
        start = at + LENGTH.size
        at = start + LENGTH.unpack_from(raw, at)[0]
        found.append(str(raw[start:at], "utf-8", "replace"))
    if at != len(raw) or len(found) != count:
        raise RemoteProtocolError(f"{len(raw)} bytes are not a {what}")
    return found
