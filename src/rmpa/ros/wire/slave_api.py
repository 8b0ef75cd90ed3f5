"""The Slave API: the methods that a node serves over XML-RPC (wiki.ros.org/ROS/Slave_API).

Pure: a call is a method with its parameters, and its result a ``RosReply(code, status, value)``. ``NodeView`` gives
the state of the node and takes the effects of calls.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Final, Protocol

from rmpa.core.identity import is_global_name, is_legal_name
from rmpa.core.limits import INT32_MAX
from rmpa.ros.wire.xmlrpc import RosReply

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from rmpa.ros.wire.xmlrpc import XmlRpcValue

TCPROS: Final = "TCPROS"
INBOUND: Final = "i"
OUTBOUND: Final = "o"
_ERROR: Final = -1
_FAILURE: Final = 0
_SUCCESS: Final = 1


@dataclass(frozen=True, slots=True)
class BusConnection:
    """One topic connection of a node, for ``getBusInfo``, ``getBusStats`` and RMPA's own tools.

    Args:
        number: The connection's number within the node.
        other: The other side: a subscriber's caller id, or a publisher's slave API URI.
        direction: ``"o"`` to a subscriber, ``"i"`` from a publisher.
        topic: The topic.
        connected: Whether messages can flow.
        info: The addresses, for people.
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
    info: str
    bytes: int
    messages: int
    dropped: int = 0
    waiting: int = 0


class NodeView(Protocol):
    """A node as the Slave API needs it."""

    def publications(self) -> Iterable[tuple[str, str]]:
        """Published topics with their types (``*`` where unknown)."""

    def subscriptions(self) -> Iterable[tuple[str, str]]:
        """Subscribed topics with their types."""

    def connections(self) -> Iterable[BusConnection]:
        """All topic connections."""

    def address_of(self, topic: str) -> tuple[str, int] | None:
        """Host and port for subscribers of a topic; ``None`` if the node does not publish it."""

    def publisher_update(self, topic: str, publishers: Sequence[str]) -> None:
        """Apply the master's list of publishers of a topic, as slave API URIs."""

    def param_update(self, key: str, value: XmlRpcValue) -> bool:
        """Handle a changed parameter (``{}`` if deleted); return ``False`` if the node has not subscribed to it."""

    def shut_down(self, reason: str) -> None:
        """Handle the master's request that the node ends."""


class SlaveApi:
    """Dispatches the calls of the Slave API.

    Args:
        name: The node's global name.
        master_uri: The URI of the node's master.
        pid: The process id.
        node: The node.
    """

    def __init__(self, name: str, master_uri: str, pid: int, node: NodeView) -> None:
        self.name = name
        self.master_uri = master_uri
        self.uri = ""
        """The node's own slave API; set once its server listens."""
        self._pid = pid
        self._node = node

    def dispatch(self, method: str, params: Sequence[XmlRpcValue]) -> RosReply:
        """Answer one call; mistakes of the caller are answered with code -1, as rospy does.

        Raises:
            KeyError: There is no such method; see ``METHODS``.
        """
        arity, default, answer = self._METHODS[method]
        if not params:
            return RosReply(_ERROR, "missing required caller_id parameter", default)
        # By the wiki the reason of shutdown is optional; rospy refuses a call without it.
        if len(params) - 1 != arity and not (method == "shutdown" and len(params) == 1):
            return RosReply(_ERROR, "Error: bad call arity", default)
        if not isinstance(params[0], str):
            return RosReply(_ERROR, "caller_id must be a string", default)
        problem = _check(method, params[1:])
        if problem is not None:
            return RosReply(_ERROR, problem, default)
        return answer(self, params[1:])

    def _bus_stats(self, _: Sequence[XmlRpcValue]) -> RosReply:
        published: dict[str, list[XmlRpcValue]] = {topic: [] for topic, _type in self._node.publications()}
        subscribed: dict[str, list[XmlRpcValue]] = {topic: [] for topic, _type in self._node.subscriptions()}
        sent: dict[str, int] = {}
        for c in self._node.connections():
            size, messages = min(c.bytes, INT32_MAX), min(c.messages, INT32_MAX)
            if c.direction == OUTBOUND:
                published.setdefault(c.topic, []).append([c.number, size, messages, c.connected])
                sent[c.topic] = min(sent.get(c.topic, 0) + c.bytes, INT32_MAX)
            else:
                subscribed.setdefault(c.topic, []).append([c.number, size, messages, -1, c.connected])
        value: list[XmlRpcValue] = [
            [[topic, sent.get(topic, 0), links] for topic, links in published.items()],
            [[topic, links] for topic, links in subscribed.items()],
            [],
        ]
        return RosReply(_SUCCESS, "", value)

    def _bus_info(self, _: Sequence[XmlRpcValue]) -> RosReply:
        return RosReply(
            _SUCCESS,
            "bus info",
            [
                [c.number, c.other, c.direction, TCPROS, c.topic, c.connected, c.info]
                for c in self._node.connections()
            ],
        )

    def _master_uri(self, _: Sequence[XmlRpcValue]) -> RosReply:
        if not self.master_uri:
            return RosReply(_FAILURE, "master URI not set", "")
        return RosReply(_SUCCESS, self.master_uri, self.master_uri)

    def _shutdown(self, params: Sequence[XmlRpcValue]) -> RosReply:
        self._node.shut_down(str(params[0]) if params else "")
        return RosReply(_SUCCESS, "shutdown", 0)

    def _get_pid(self, _: Sequence[XmlRpcValue]) -> RosReply:
        return RosReply(_SUCCESS, "", self._pid)

    def _subscriptions(self, _: Sequence[XmlRpcValue]) -> RosReply:
        return RosReply(_SUCCESS, "subscriptions", [list(pair) for pair in self._node.subscriptions()])

    def _publications(self, _: Sequence[XmlRpcValue]) -> RosReply:
        return RosReply(_SUCCESS, "publications", [list(pair) for pair in self._node.publications()])

    def _param_update(self, params: Sequence[XmlRpcValue]) -> RosReply:
        # rosmaster appends a slash to the key, and roscpp removes it.
        key = str(params[0]).rstrip("/") or "/"
        if self._node.param_update(key, params[1]):
            return RosReply(_SUCCESS, "", 0)
        return RosReply(_ERROR, "not subscribed", 0)

    def _publisher_update(self, params: Sequence[XmlRpcValue]) -> RosReply:
        topic, publishers = params
        if isinstance(publishers, list):
            self._node.publisher_update(str(topic), [str(uri) for uri in publishers])
        return RosReply(_SUCCESS, "", 0)

    def _request_topic(self, params: Sequence[XmlRpcValue]) -> RosReply:
        topic, protocols = str(params[0]), params[1]
        address = self._node.address_of(topic)
        if address is None:
            return RosReply(_ERROR, f"Not a publisher of [{topic}]", [])
        if isinstance(protocols, list) and any(isinstance(p, list) and p and p[0] == TCPROS for p in protocols):
            return RosReply(_SUCCESS, f"ready on {address[0]}:{address[1]}", [TCPROS, address[0], address[1]])
        return RosReply(_FAILURE, "no supported protocol implementations", [])

    def _get_name(self, _: Sequence[XmlRpcValue]) -> RosReply:
        return RosReply(_SUCCESS, "", self.name)

    def _get_uri(self, _: Sequence[XmlRpcValue]) -> RosReply:
        return RosReply(_SUCCESS, "", self.uri)

    _METHODS: ClassVar[
        Mapping[str, tuple[int, XmlRpcValue, Callable[[SlaveApi, Sequence[XmlRpcValue]], RosReply]]]
    ] = {
        "getBusStats": (0, [], _bus_stats),
        "getBusInfo": (0, [], _bus_info),
        "getMasterUri": (0, "", _master_uri),
        "shutdown": (1, 0, _shutdown),
        "getPid": (0, -1, _get_pid),
        "getSubscriptions": (0, [], _subscriptions),
        "getPublications": (0, [], _publications),
        "paramUpdate": (2, -1, _param_update),
        "publisherUpdate": (2, -1, _publisher_update),
        "requestTopic": (2, [], _request_topic),
        "getName": (0, "", _get_name),
        "getUri": (0, "", _get_uri),
    }
    """By method: the number of parameters after the caller id, the value in an error's reply, and the function."""


METHODS: Final = tuple(SlaveApi._METHODS)  # noqa: SLF001 - the same module
"""The names of all methods."""


def _check(method: str, params: Sequence[XmlRpcValue]) -> str | None:
    """Check the parameters after the caller id; return the text of an error, or ``None``."""
    if method in ("publisherUpdate", "requestTopic"):
        topic, items = params
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
    if method == "paramUpdate" and not (isinstance(params[0], str) and is_global_name(params[0].rstrip("/") or "/")):
        return "parameter_key must be a global name"
    return None


# What other nodes answer to ``getBusInfo``: their topic connections. Pure.
#
# The wiki (wiki.ros.org/ROS/Slave_API) leaves much open, and the libraries differ. A row that cannot be read is
# left
# out, and so is what is unknown in one that can: a node may be of any library.


_INFO: Final = re.compile(r"on port ([0-9]{1,5}) to \[([^\s\[\]]+):([0-9]{1,5})(?: on socket \w+)?\]")
"""``TCPROS connection on port 46087 to [10.0.0.1:45225 on socket 12]``; the socket is not always named."""
_CLOSED: Final = "Closed "
"""How rospy's text begins for a connection that has ended; the row says that it is connected all the same."""
_PORT_MAX: Final = 65535

_REPLY_LENGTH: Final = 3


@dataclass(frozen=True, slots=True)
class BusLink:
    """One connection of a node, as ``getBusInfo`` has it.

    Args:
        number: Its number within the node.
        other: The other side: a subscriber's caller id, or a publisher's slave API URI.
        inbound: Whether it is from a publisher; else it is to a subscriber.
        topic: The topic.
        connected: Whether messages can flow, as far as the node knows.
        local_port: The port of the node's end of a TCP connection; ``None`` if the node does not say it.
        remote: Host and port of the other end of a TCP connection, likewise. The host is an address, or the name that
            the publisher goes by.
    """

    number: int
    other: str
    inbound: bool
    topic: str
    connected: bool
    local_port: int | None
    remote: tuple[str, int] | None


def read_bus_info(answer: XmlRpcValue) -> list[BusLink]:
    """The connections of a node.

    Args:
        answer: The node's answer to ``getBusInfo``: code, status and value, or the value alone.
    """
    return [link for row in _list(_value_of(answer)) if (link := _link(_list(row))) is not None]


def _value_of(answer: XmlRpcValue) -> XmlRpcValue:
    """The value in an answer with code and status; nothing if the code is that of an error."""
    parts = _list(answer)
    if len(parts) == _REPLY_LENGTH and (code := _int(parts[0])) is not None:
        return parts[2] if code == _SUCCESS else None
    return answer


def _link(row: Sequence[XmlRpcValue]) -> BusLink | None:
    number, other, direction, topic, info = _int(_at(row, 0)), _at(row, 1), _at(row, 2), _at(row, 4), _at(row, 6)
    if number is None or not isinstance(other, str) or not isinstance(topic, str):
        return None
    if direction not in (INBOUND, OUTBOUND):
        return None
    text = info if isinstance(info, str) else ""
    local, remote = _addresses(text) if _at(row, 3) == TCPROS else (None, None)
    standing = _at(row, 5) in (True, 1) and not text.startswith(_CLOSED)
    return BusLink(number, other, direction == INBOUND, topic, standing, local, remote)


def _addresses(info: str) -> tuple[int | None, tuple[str, int] | None]:
    """The local port, and the remote host and port, in the text about a connection."""
    found = _INFO.search(info)
    if found is None:
        return None, None
    local, host, port = int(found[1]), found[2], int(found[3])
    return (local if 0 < local <= _PORT_MAX else None, (host, port) if 0 < port <= _PORT_MAX else None)


def _list(value: XmlRpcValue) -> Sequence[XmlRpcValue]:
    return value if isinstance(value, list | tuple) else ()


def _at(row: Sequence[XmlRpcValue], index: int) -> XmlRpcValue:
    return row[index] if index < len(row) else None


def _int(value: XmlRpcValue) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) else None
