"""The Slave API: the methods that a node serves over XML-RPC (wiki.ros.org/ROS/Slave_API).

Pure: what is checked of a call before ``SlaveNode`` answers it, and the tables of connections, written and read.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

from rmpa.core.identity import is_global_name, is_legal_name
from rmpa.core.limits import INT32_MAX
from rmpa.ros.wire.tcpros import LENGTH

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from rmpa.ros.wire.xmlrpc import XmlRpcValue

TCPROS: Final = "TCPROS"
INBOUND: Final = "i"
OUTBOUND: Final = "o"
_PORT_MAX: Final = 65535
# In the text about a connection; the socket is not always named.
_INFO: Final = re.compile(r"on port ([0-9]{1,5}) to \[([^\s\[\]]+):([0-9]{1,5})(?: on socket \w+)?\]")


@dataclass(frozen=True, slots=True)
class BusConnection:
    """One topic connection of a node, as ``getBusInfo`` and ``getBusStats`` have it.

    Args:
        number: The connection's number within the node.
        other: The other side: a subscriber's caller id, or a publisher's slave API URI.
        direction: ``"o"`` to a subscriber, ``"i"`` from a publisher.
        topic: The topic.
        connected: Whether messages can flow, as far as the node knows.
        info: The addresses, for people: ``TCPROS connection on port 46087 to [10.0.0.1:45225 on socket 12]``.
        bytes: Bytes sent or received.
        messages: Messages sent or received.
        dropped: Messages dropped because the other side is slow; 0 inbound.
        waiting: Bytes queued because the other side is slow; 0 inbound.
    """

    number: int
    other: str
    direction: str
    topic: str
    connected: bool
    info: str = ""
    bytes: int = 0
    messages: int = 0
    dropped: int = 0
    waiting: int = 0

    @property
    def inbound(self) -> bool:
        """Whether it is from a publisher."""
        return self.direction == INBOUND

    @property
    def local_port(self) -> int | None:
        """The port of the node's end of a TCP connection; ``None`` if the node does not say it."""
        found = _INFO.search(self.info)
        return _port(found[1]) if found is not None else None

    @property
    def remote(self) -> tuple[str, int] | None:
        """Host and port of the other end, likewise; the host is an address, or a name that the publisher goes by."""
        found = _INFO.search(self.info)
        port = _port(found[3]) if found is not None else None
        return (found[2], port) if found is not None and port is not None else None


def _port(text: str) -> int | None:
    return int(text) if 0 < int(text) <= _PORT_MAX else None


# By method: the number of parameters after the caller id, and the value in an error's reply.
METHODS: Final[Mapping[str, tuple[int, XmlRpcValue]]] = {
    "getBusStats": (0, []),
    "getBusInfo": (0, []),
    "getMasterUri": (0, ""),
    "shutdown": (1, 0),
    "getPid": (0, -1),
    "getSubscriptions": (0, []),
    "getPublications": (0, []),
    "paramUpdate": (2, -1),
    "publisherUpdate": (2, -1),
    "requestTopic": (2, []),
    "getName": (0, ""),
    "getUri": (0, ""),
}


def check_call(method: str, params: Sequence[XmlRpcValue]) -> str | None:
    """Check the parameters of a call; return the text of an error, which is answered with code -1, or ``None``."""
    arity = METHODS[method][0]
    if not params:
        return "missing required caller_id parameter"
    # By the wiki the reason of shutdown is optional; rospy refuses a call without it.
    if len(params) - 1 != arity and not (method == "shutdown" and len(params) == 1):
        return "Error: bad call arity"
    if not isinstance(params[0], str):
        return "caller_id must be a string"
    if method in ("publisherUpdate", "requestTopic"):
        _, topic, items = params
        if not isinstance(topic, str) or not topic:
            return "topic name must be a non-empty string"
        if not is_legal_name(topic):
            return f"topic name [{topic}] contains illegal chars"
        if not isinstance(items, list):
            return f"{'publishers' if method == 'publisherUpdate' else 'protocols'} must be a list"
        if method == "requestTopic" and not items:
            return "ERROR: parameter [protocols] must be specified and non-empty"
        if method == "publisherUpdate" and not all(isinstance(uri, str) and "://" in uri for uri in items):
            return "publishers must be a list of URIs"
    if method == "paramUpdate" and not (isinstance(params[1], str) and is_global_name(params[1].rstrip("/") or "/")):
        return "parameter_key must be a global name"
    return None


def bus_stats(
    published: Iterable[str], subscribed: Iterable[str], connections: Iterable[BusConnection]
) -> list[XmlRpcValue]:
    """The value of ``getBusStats``, for a node that publishes and subscribes to these topics."""
    out: dict[str, list[XmlRpcValue]] = {topic: [] for topic in published}
    into: dict[str, list[XmlRpcValue]] = {topic: [] for topic in subscribed}
    sent: dict[str, int] = {}
    for c in connections:
        size, messages = min(c.bytes, INT32_MAX), min(c.messages, INT32_MAX)
        if c.direction == OUTBOUND:
            out.setdefault(c.topic, []).append([c.number, size, messages, c.connected])
            sent[c.topic] = min(sent.get(c.topic, 0) + c.bytes, INT32_MAX)
        else:
            into.setdefault(c.topic, []).append([c.number, size, messages, -1, c.connected])
    return [
        [[topic, sent.get(topic, 0), links] for topic, links in out.items()],
        [[topic, links] for topic, links in into.items()],
        [],
    ]


def bus_info(connections: Iterable[BusConnection]) -> list[XmlRpcValue]:
    """The value of ``getBusInfo``, in rospy's form."""
    return [[c.number, c.other, c.direction, TCPROS, c.topic, c.connected, c.info] for c in connections]


# What other nodes answer to ``getBusInfo``. Their topic connections. Pure.
#
# The wiki (wiki.ros.org/ROS/Slave_API) leaves much open, and the libraries differ. A row that cannot be read is left
# out, and so is what is unknown in one that can: a node may be of any library.


# How rospy's text begins for a connection that has ended; the row says that it is connected all the same.
_CLOSED: Final = "Closed "


def read_bus_info(answer: XmlRpcValue) -> list[BusConnection]:
    """The connections of a node.

    Args:
        answer: The node's answer to ``getBusInfo``: code, status and value, or the value alone.
    """
    match answer:
        case [int(code), _, rows] if not isinstance(code, bool):
            answer = rows if code == 1 else None
    return [link for row in _list(answer) if (link := _link(_list(row))) is not None]


# Messages and bytes that went over each outbound connection of one topic, by the connection's number.
Sent: TypeAlias = dict[int, tuple[int, int]]


def read_bus_stats(answer: XmlRpcValue) -> dict[str, Sent]:
    """What a node has sent on each topic that it publishes.

    rospy answers code, status and value, and has ``[number, bytes, messages, connected]`` for a connection; roscpp
    answers the value alone, with ``[number, bytes, bytes of messages, messages, 0]``.

    Args:
        answer: The node's answer to ``getBusStats``.
    """
    match answer:
        case [int(), str(), value]:
            answer = value
    found: dict[str, Sent] = {}
    for row in _list(next(iter(_list(answer)), None)):
        match row:
            case [str(topic), *_, links]:
                sent = found[topic] = {}
                for link in _list(links):
                    match link:
                        case [int(number), int(size), int(messages), _] | [
                            int(number),
                            _,
                            int(size),
                            int(messages),
                            _,
                        ]:
                            sent[number] = messages, size
    return found


def sent_between(before: Sent, after: Sent) -> tuple[int, int] | None:
    """Messages and bytes sent to one subscriber between two answers of a node; ``None`` if no connection lasted.

    Of several connections that with the most counts: a slow subscriber's leaves messages out. Both libraries count
    the length in front of each message, which is left out here, in counters of 32 bits.
    """
    found = [
        tuple((new - old) % 2**32 for new, old in zip(sent, before[link], strict=True))
        for link, sent in after.items()
        if link in before
    ]
    if not found:
        return None
    messages, size = max(found)
    return messages, max(0, size - LENGTH.size * messages)


def _link(row: Sequence[XmlRpcValue]) -> BusConnection | None:
    number, other, direction, transport, topic, connected, info = [*row, *(None,) * 7][:7]
    if not isinstance(number, int) or isinstance(number, bool) or direction not in (INBOUND, OUTBOUND):
        return None
    if not isinstance(other, str) or not isinstance(topic, str):
        return None
    text = info if isinstance(info, str) else ""
    standing = connected in (True, 1) and not text.startswith(_CLOSED)
    return BusConnection(number, other, str(direction), topic, standing, text if transport == TCPROS else "")


def _list(value: XmlRpcValue) -> Sequence[XmlRpcValue]:
    return value if isinstance(value, list | tuple) else ()
