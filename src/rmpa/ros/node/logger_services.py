"""``get_loggers`` and ``set_logger_level`` of a node of this process, as every roscpp and rospy node has them.

With them rqt_logger_level and ``rosservice call /rmpa/set_logger_level rmpa.mesh debug`` set the levels of this
program's log while it runs. The messages (roscpp/GetLoggers, roscpp/SetLoggerLevel) are serialized by hand, because
the agent starts without rosbags and numpy.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.ros.node.service_server import ServiceEndpoint
from rmpa.ros.wire.services import ServiceDescription
from rmpa.ros.wire.tcpros import LENGTH, printable

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rmpa.ros.node.service_server import ServiceCall
    from rmpa.ros.node.slave_node import SlaveNode
    from rmpa.ros.wire.tcpros import Buffer
    from rmpa.ros.wire.xmlrpc import RosReply

_log = logging.getLogger(__name__)

GET: Final = ServiceDescription("roscpp/GetLoggers", "32e97e85527d4678a8f9279894bb64b0")
SET: Final = ServiceDescription("roscpp/SetLoggerLevel", "51da076440d78ca1684d36c868df61ea")
_LEVELS: Final = {
    "debug": logging.DEBUG,
    "info": logging.INFO,
    "warn": logging.WARNING,
    "error": logging.ERROR,
    "fatal": logging.CRITICAL,
}


class LoggerServices:
    """The two services of one node.

    Args:
        node: Serves them.
        call: Calls the core's master.
        loggers: The name of Python's logger, by the name that the services show.
    """

    def __init__(self, node: SlaveNode, call: Callable[..., RosReply], loggers: Mapping[str, str]) -> None:
        self._node = node
        self._call = call
        self._loggers = loggers
        self._endpoints = (
            ServiceEndpoint(f"{node.name}/get_loggers", node.name, self._get, description=GET),
            ServiceEndpoint(f"{node.name}/set_logger_level", node.name, self._set, description=SET),
        )

    def start(self) -> None:
        """Serve and register; the node listens already."""
        node = self._node
        for endpoint in self._endpoints:
            node.add_service(endpoint)
            code, text, _ = self._call("registerService", node.name, endpoint.service, node.service_uri, node.uri)
            if code != 1:
                _log.error("! the local core does not take %s: %s", endpoint.service, text)

    def close(self) -> None:
        """Unregister, and stop serving."""
        node = self._node
        for endpoint in self._endpoints:
            self._call("unregisterService", node.name, endpoint.service, node.service_uri)
            node.remove_service(endpoint.service)

    def _get(self, call: ServiceCall) -> None:
        parts = [LENGTH.pack(len(self._loggers))]
        for name, logger in self._loggers.items():
            level = logging.getLogger(logger).getEffectiveLevel()
            # The highest ROS level that is not above the logger's level.
            word = next((w for w, number in reversed(_LEVELS.items()) if number <= level), "debug")
            parts += [_string(name), _string(word)]
        call.reply(True, b"".join(parts))

    def _set(self, call: ServiceCall) -> None:
        name, level = _strings(call.request)
        logger, number = self._loggers.get(name), _LEVELS.get(level.lower())
        if logger is None:
            known = ", ".join(self._loggers)
            call.fail(f"{self._node.name} has no logger {printable(name)!r}; it has {known}")
        elif number is None:
            call.fail(f"{printable(level)!r} is not a level; there are {', '.join(_LEVELS)}")
        else:
            _log.info("= %s sets the level of %s to %s", printable(call.caller_id), name, level.lower())
            logging.getLogger(logger).setLevel(number)
            call.reply(True, b"")


def _string(text: str) -> bytes:
    raw = text.encode()
    return LENGTH.pack(len(raw)) + raw


def _strings(raw: Buffer) -> tuple[str, str]:
    """The two strings of a request."""
    found: list[str] = []
    start = 0
    for _ in range(2):
        end = start + LENGTH.size
        if end > len(raw):
            break
        (size,) = LENGTH.unpack_from(raw, start)
        start, end = end, end + size
        if end > len(raw):
            break
        found.append(str(raw[start:end], "utf-8", "replace"))
        start = end
    if len(found) != 2 or start != len(raw):
        raise RemoteProtocolError(f"{len(raw)} bytes are not a roscpp/SetLoggerLevelRequest")
    return found[0], found[1]
