"""Liveliness tokens of ROS 2 over Zenoh: the graph of nodes and endpoints.

Each node and each endpoint of ROS 2 declares a token; what declares none is not seen by ``ros2 topic list``::

    @ros2_lv/<domain>/<zid>/<node id>/<node id>/NN/<enclave>/<namespace>/<node>
    @ros2_lv/<domain>/<zid>/<node id>/<id>/MP|MS|SS|SC/<enclave>/<namespace>/<node>/<name>/<type>/<hash>/<QoS>

``zid`` is the Zenoh session. Within a part ``/`` is written as ``%``, and an empty part is ``%``. Data, and calls of
services, go by the key ``<domain>/<name>/<type>/<hash>``. A subscriber whose type has another hash listens at another
key: it hears nothing, and is told nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.ros2.qos import Ros2Qos

ADMIN_SPACE: Final = "@ros2_lv"
"""The first chunk of each token; ``**`` does not match it, as it begins with ``@``."""
NO_HASH: Final = "TypeHashNotSupported"
"""The type hash of ROS 2 Humble, which has none."""
_EMPTY: Final = "%"
_NODE_PARTS: Final = 9
_ENDPOINT_PARTS: Final = 13
_WILD: Final = frozenset("*$?#")
_SEPARATOR: Final = "::"
_DDS: Final = "dds_"


class EntityKind(StrEnum):
    """What a token stands for; the value is its mark in the token."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"
    SERVICE = "SS"
    CLIENT = "SC"


@dataclass(frozen=True, slots=True)
class Ros2Node:
    """A node of ROS 2.

    Args:
        domain: Its ROS domain id.
        zid: Its Zenoh session, in hexadecimal digits as Zenoh writes it.
        number: Its number in that session.
        name: Its full name, ``/namespace/node``.
        enclave: Its enclave of SROS 2; empty for none.
    """

    domain: int
    zid: str
    number: int
    name: str
    enclave: str = ""

    def token(self) -> str:
        """The node's liveliness token."""
        return f"{self._head(self.number, EntityKind.NODE)}"

    def _head(self, number: int, kind: EntityKind) -> str:
        namespace, _, name = self.name.rpartition("/")
        parts = (self.domain, self.zid, self.number, number, kind, *map(_mangle, (self.enclave, namespace, name)))
        return "/".join((ADMIN_SPACE, *map(str, parts)))


@dataclass(frozen=True, slots=True)
class Ros2Endpoint:
    """A publisher, a subscription, a service's server or its client.

    Args:
        node: Its node.
        number: Its number in the node's session.
        kind: What it is.
        name: The topic's or service's full name, ``/like/this``.
        type: Its type, ``package/msg/Name`` or ``package/srv/Name``.
        type_hash: The hash of its type, ``RIHS01_`` and 64 hexadecimal digits (REP 2016).
        qos: Its QoS.
    """

    node: Ros2Node
    number: int
    kind: EntityKind
    name: str
    type: str
    type_hash: str
    qos: Ros2Qos

    def token(self) -> str:
        """The endpoint's liveliness token."""
        head = self.node._head(self.number, self.kind)  # noqa: SLF001 - the two are one format
        return "/".join((head, _mangle(self.name), dds_type(self.type), self.type_hash, self.qos.serialize()))

    def key(self) -> str:
        """The key of its messages or calls."""
        return data_key(self.node.domain, self.name, self.type, self.type_hash)


def data_key(domain: int, name: str, type_name: str, type_hash: str) -> str:
    """The key of a topic's messages, or of a service's calls.

    Args:
        domain: The ROS domain id.
        name: The full name, ``/like/this``.
        type_name: ``package/msg/Name`` or ``package/srv/Name``.
        type_hash: The hash of the type; ``*`` for each.
    """
    return f"{domain}/{name.strip('/')}/{dds_type(type_name)}/{type_hash}"


def graph_key(domain: int) -> str:
    """The key expression that all tokens of a ROS domain match."""
    return f"{ADMIN_SPACE}/{domain}/**"


def parse_token(key: str) -> Ros2Node | Ros2Endpoint:
    """Read a liveliness token.

    Raises:
        RemoteProtocolError: It has another form. The parts behind those that are known are ignored.
    """
    if len(key) > limits.KEY_MAX:
        raise RemoteProtocolError(f"a liveliness token has {len(key)} characters; at most {limits.KEY_MAX} are read")
    parts = key.split("/")
    if len(parts) < _NODE_PARTS or parts[0] != ADMIN_SPACE or not all(parts):
        raise RemoteProtocolError(f"{_short(key)} is not a liveliness token of ROS 2")
    if not _WILD.isdisjoint(key):
        raise RemoteProtocolError(f"{_short(key)} is an expression, not a liveliness token")
    try:
        kind = EntityKind(parts[5])
    except ValueError:
        raise RemoteProtocolError(f"{_short(key)}: {parts[5][:20]!r} is no kind of entity") from None
    domain = _number(parts[1], limits.DOMAIN_MAX, key)
    enclave, namespace, name = (_demangle(part) for part in parts[6:9])
    if not name or "/" in name:
        raise RemoteProtocolError(f"{_short(key)} has no name of a node")
    full = f"{_absolute(namespace)}/{name}" if namespace else f"/{name}"
    node = Ros2Node(domain, parts[2], _number(parts[3], limits.ENTITY_ID_MAX, key), full, enclave)
    if kind is EntityKind.NODE:
        return node
    if len(parts) < _ENDPOINT_PARTS:
        raise RemoteProtocolError(f"{_short(key)} has {len(parts)} parts; an endpoint's has {_ENDPOINT_PARTS}")
    number = _number(parts[4], limits.ENTITY_ID_MAX, key)
    name = _absolute(_demangle(parts[9]))
    return Ros2Endpoint(node, number, kind, name, ros_type(parts[10]), parts[11], Ros2Qos.parse(parts[12]))


def dds_type(name: str) -> str:
    """The name of a type in keys: ``std_msgs/msg/String`` is ``std_msgs::msg::dds_::String_``.

    Raises:
        ValueError: The name has not three parts.
    """
    package, kind, base = name.split("/")
    return _SEPARATOR.join((package, kind, _DDS, base + "_"))


def ros_type(name: str) -> str:
    """The ROS name of a type in a key; the inverse of :func:`dds_type`.

    Raises:
        RemoteProtocolError: It is no such name.
    """
    parts = name.split(_SEPARATOR)
    if len(parts) != 4 or parts[2] != _DDS or not parts[3].endswith("_") or not all((*parts, parts[3][:-1])):
        raise RemoteProtocolError(f"{name[:80]!r} is not the name of a type of ROS 2")
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"


def _mangle(name: str) -> str:
    return name.replace("/", _EMPTY) or _EMPTY


def _demangle(part: str) -> str:
    return "" if part == _EMPTY else part.replace(_EMPTY, "/")


def _absolute(name: str) -> str:
    return name if name.startswith("/") else f"/{name}"


def _number(text: str, largest: int, key: str) -> int:
    if text.isascii() and text.isdigit() and len(text) <= len(str(largest)) and int(text) <= largest:
        return int(text)
    raise RemoteProtocolError(f"{_short(key)}: {text[:20]!r} is not a number up to {largest}")


def _short(key: str) -> str:
    return repr(key[:120])
