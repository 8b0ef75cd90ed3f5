"""What other nodes answer to ``getBusInfo``: their topic connections. Pure.

The wiki (wiki.ros.org/ROS/Slave_API) leaves much open, and the libraries differ. A row that cannot be read is left
out, and so is what is unknown in one that can: a node may be of any library.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.ros.wire.slave_api import INBOUND, OUTBOUND, TCPROS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.ros.wire.xmlrpc import XmlRpcValue

_INFO: Final = re.compile(r"on port ([0-9]{1,5}) to \[([^\s\[\]]+):([0-9]{1,5})(?: on socket \w+)?\]")
"""``TCPROS connection on port 46087 to [10.0.0.1:45225 on socket 12]``; the socket is not always named."""
_CLOSED: Final = "Closed "
"""How rospy's text begins for a connection that has ended; the row says that it is connected all the same."""
_PORT_MAX: Final = 65535
_SUCCESS: Final = 1
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
