"""The formats of rmw_zenoh: tokens, QoS, and the attachment of messages, requests and replies.

The attachment of each message, request and reply of ROS 2 over Zenoh.

33 bytes, little-endian; rmw_zenoh_cpp writes it with zenoh's serializer::

     0 sequence   8 bytes   counts the messages of a publisher, or the requests of a client, from 1; signed
     8 stamp      8 bytes   the source's wall clock, nanoseconds since 1970; signed
    16 length     1 byte    of the GID: 16 since ROS 2 Jazzy
    17 gid       16 bytes   which publisher or client it is

A reply repeats sequence and GID of its request, and has a stamp of its own.

Up to rmw_zenoh_cpp 0.2.3 of Jazzy each of the three has its name in front, with a length of one byte:
``sequence_number``, ``source_timestamp``, ``source_gid`` (ros2/rmw_zenoh#605). That is read too, and not written.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import TYPE_CHECKING, Any, Final, TypeVar

from msgspec import UNSET

from rmpa.core.contract import Contract, Contracts, Durability, History, Liveliness, Reliability
from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.zenoh.threads import PRIORITIES, ZenohQos

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.ros.wire.tcpros import Buffer

# Bytes of the source's GID in an attachment of ROS 2: its length is one byte.
_GID_MAX: Final = 255
# The largest number of a node or an endpoint in a liveliness token.
_ENTITY_ID_MAX: Final = 2**64 - 1
# The largest ROS domain id in a key; ROS 2 uses 0 to 232.
_DOMAIN_MAX: Final = 2**32 - 1

# Bytes of a GID since ROS 2 Jazzy.
GID_BYTES: Final = 16
# The namespace of the nodes that gateways declare: ``/rmpa/<module>/<node>``, as in the graphs of ROS 1. No ROS
# 2 node may use it: one that does is taken for a gateway's, and ignored. So two gateways in one domain make no
# loop.
OWN_NAMESPACE: Final = "/rmpa/"
_HEAD: Final = struct.Struct("<qqB")
_LABELS: Final = (b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid")
_NUMBER: Final = 8


@dataclass(frozen=True, slots=True)
class Ros2Attachment:
    """What goes with a message of ROS 2.

    Args:
        sequence: The number of the message or request at its source, from 1.
        stamp: When it was published, in nanoseconds since 1970.
        gid: The source's GID, 16 bytes.
    """

    sequence: int
    stamp: int
    gid: bytes

    def serialize(self) -> bytes:
        """The bytes of the attachment."""
        return _HEAD.pack(self.sequence, self.stamp, len(self.gid)) + self.gid

    @classmethod
    def parse(cls, data: Buffer) -> Ros2Attachment:
        """Read an attachment; bytes behind the GID are ignored, so that later versions may add to it.

        Raises:
            RemoteProtocolError: It is shorter than it says.
        """
        raw = memoryview(data)
        if bytes(raw[: len(_LABELS[0])]) == _LABELS[0]:
            raw = _without_labels(raw)
        if len(raw) < _HEAD.size:
            raise RemoteProtocolError(f"an attachment of ROS 2 has {len(raw)} bytes; the least are {_HEAD.size}")
        sequence, stamp, length = _HEAD.unpack_from(raw)
        gid = bytes(raw[_HEAD.size : _HEAD.size + length])
        if len(gid) < length or length > _GID_MAX:
            raise RemoteProtocolError(f"an attachment of ROS 2 has {len(gid)} bytes of a GID of {length}")
        return cls(sequence, stamp, gid)


def _without_labels(raw: memoryview) -> memoryview:
    """The older form without the names."""
    made = b""
    for label in _LABELS:
        if bytes(raw[: len(label)]) != label:
            raise RemoteProtocolError(f"an attachment of ROS 2 has no {label[1:].decode()} where it should be")
        raw = raw[len(label) :]
        if label is not _LABELS[-1]:
            made += bytes(raw[:_NUMBER])
            raw = raw[_NUMBER:]
    return memoryview(made + bytes(raw))


# The QoS of a ROS 2 endpoint, and its text in a liveliness token. The text is
# ``reliability:durability:history,depth:deadline:lifespan:liveliness,lease``, where a duration is
# ``seconds,nanoseconds``. A value that is rmw's default is left out, but for the depth of *keep last*: a publisher
# with the default QoS has ``::,10:,:,:,,``, a latched one ``:1:,1:,:,:,,``. The numbers are those of rmw/types.h.


# A duration that never ends, in nanoseconds: the default of all durations (RMW_DURATION_INFINITE).
INFINITE: Final = 2**63 - 1
_NANO: Final = 1_000_000_000
_PARTS: Final = 6
# Messages that *keep last* keeps by default.
DEFAULT_DEPTH: Final = 10


# Whether a message that is lost on the way is sent again.
Ros2Reliability = IntEnum("Ros2Reliability", "RELIABLE BEST_EFFORT")
# Whether a later subscriber gets earlier messages; ``TRANSIENT_LOCAL`` is what ROS 1 calls latched.
Ros2Durability = IntEnum("Ros2Durability", "TRANSIENT_LOCAL VOLATILE")
# How many messages an endpoint keeps.
Ros2History = IntEnum("Ros2History", "KEEP_LAST KEEP_ALL")
# How a publisher shows that it is alive.
Ros2Liveliness = IntEnum("Ros2Liveliness", "AUTOMATIC MANUAL_BY_NODE MANUAL_BY_TOPIC")
_Kind = TypeVar("_Kind", bound=IntEnum)


@dataclass(frozen=True, slots=True)
class Ros2Qos:
    """The QoS of one endpoint; the defaults are rmw's for topics.

    Args:
        reliability: See :class:`Ros2Reliability`.
        durability: See :class:`Ros2Durability`.
        history: See :class:`Ros2History`.
        depth: Messages that *keep last* keeps.
        deadline: The longest time between two messages, in nanoseconds.
        lifespan: How long a message is of use, in nanoseconds.
        liveliness: See :class:`Ros2Liveliness`.
        lease: Silence after which a publisher counts as dead, in nanoseconds.
    """

    reliability: Ros2Reliability = Ros2Reliability.RELIABLE
    durability: Ros2Durability = Ros2Durability.VOLATILE
    history: Ros2History = Ros2History.KEEP_LAST
    depth: int = DEFAULT_DEPTH
    deadline: int = INFINITE
    lifespan: int = INFINITE
    liveliness: Ros2Liveliness = Ros2Liveliness.AUTOMATIC
    lease: int = INFINITE

    @property
    def latched(self) -> bool:
        """Whether a later subscriber gets the last messages, as of a latched publisher of ROS 1."""
        return self.durability is Ros2Durability.TRANSIENT_LOCAL

    def serialize(self) -> str:
        """The text in a liveliness token."""
        kinds = (
            str(int(at)) if (at := getattr(self, name)) != getattr(USUAL_QOS, name) else "" for name, _ in _KINDS
        )
        reliability, durability, history, liveliness = kinds
        deadline, lifespan, lease = (_duration(getattr(self, name)) for name in _TIMES)
        return f"{reliability}:{durability}:{history},{self.depth}:{deadline}:{lifespan}:{liveliness},{lease}"

    @classmethod
    def parse(cls, text: str) -> Ros2Qos:
        """Read the text of a token. A value that this version does not know counts as the default.

        Raises:
            RemoteProtocolError: The text has another form.
        """
        parts = text.split(":")
        if len(parts) < _PARTS:
            raise RemoteProtocolError(f"the QoS {text[:80]!r} has {len(parts)} parts instead of {_PARTS}")
        history, _, depth = parts[2].partition(",")
        liveliness, _, lease = parts[5].partition(",")
        return cls(
            _kind(Ros2Reliability, parts[0], USUAL_QOS.reliability),
            _kind(Ros2Durability, parts[1], USUAL_QOS.durability),
            _kind(Ros2History, history, USUAL_QOS.history),
            _number(depth, DEFAULT_DEPTH),
            _duration_nanoseconds(parts[3]),
            _duration_nanoseconds(parts[4]),
            _kind(Ros2Liveliness, liveliness, USUAL_QOS.liveliness),
            _duration_nanoseconds(lease),
        )


# The fields of a QoS that are kinds, and those that are times, as rclpy names them (the lease is shorter here).
_KINDS: Final[tuple[tuple[str, type[IntEnum]], ...]] = (
    ("reliability", Ros2Reliability),
    ("durability", Ros2Durability),
    ("history", Ros2History),
    ("liveliness", Ros2Liveliness),
)
_TIMES: Final = ("deadline", "lifespan", "lease")
# The QoS that rmw gives topics and services.
USUAL_QOS: Final = Ros2Qos()


def qos_fields(qos: Ros2Qos) -> dict[str, int]:
    """The numbers of a QoS that are not rmw's defaults, and its depth: what the process of rclpy reads."""
    numbers = {name: int(getattr(qos, name)) for name in (*dict(_KINDS), *_TIMES)}
    return {"depth": qos.depth, **{name: each for name, each in numbers.items() if each != getattr(USUAL_QOS, name)}}


def qos_of_fields(fields: Mapping[str, Any]) -> Ros2Qos:
    """A QoS as the process of rclpy tells it."""
    kinds = {name: _known(kind, fields.get(name, 0), getattr(USUAL_QOS, name)) for name, kind in _KINDS}
    return Ros2Qos(**kinds, **{name: fields[name] for name in ("depth", *_TIMES) if name in fields})


def _duration(nanoseconds: int) -> str:
    return "," if nanoseconds == INFINITE else "{},{}".format(*divmod(nanoseconds, _NANO))


def _duration_nanoseconds(text: str) -> int:
    seconds, _, nanoseconds = text.partition(",")
    if not seconds and not nanoseconds:
        return INFINITE
    return min(_number(seconds, 0) * _NANO + _number(nanoseconds, 0), INFINITE)


def _number(text: str, default: int) -> int:
    if not text:
        return default
    # int() also takes "+1", "1_0" and digits of other scripts.
    if not (text.isascii() and text.isdigit() and len(text) <= len(str(limits.QOS_NUMBER_MAX))):
        raise RemoteProtocolError(f"{text[:40]!r} in a QoS is not a number")
    return min(int(text), limits.QOS_NUMBER_MAX)


def _kind(kind: type[_Kind], text: str, default: _Kind) -> _Kind:
    return _known(kind, _number(text, int(default)), default)


def _known(kind: type[_Kind], number: int, default: _Kind) -> _Kind:
    try:
        return kind(number)
    except ValueError:
        return default  # 0 is the system's default, and rmw has more kinds than these


# The QoS of a topic that goes out to ROS 2. Its contract in ROS 2's words, and in Zenoh's.


def ros2_qos(
    contracts: Contracts, topic: str, type_name: str, *, latching: bool, depth: int = DEFAULT_DEPTH
) -> Ros2Qos:
    """The QoS of a topic's publisher in ROS 2's graph.

    A topic whose contract no rule makes *best effort* is reliable, as TCPROS is and as ROS 2's default has it.

    Args:
        contracts: The rules.
        topic: The topic.
        type_name: ``package/Name`` of ROS 1.
        latching: Whether its publisher latches: then it is transient local with a depth of 1.
        depth: Of a volatile topic whose contract says none.
    """
    contract = contracts.of(topic, type_name)
    best_effort = contract.reliability is Reliability.BEST_EFFORT and contracts.is_set(
        "reliability", topic, type_name
    )
    kept = latching or contract.durability is Durability.TRANSIENT_LOCAL
    manual = contract.liveliness is Liveliness.MANUAL_BY_TOPIC
    return Ros2Qos(
        Ros2Reliability.BEST_EFFORT if best_effort else Ros2Reliability.RELIABLE,
        Ros2Durability.TRANSIENT_LOCAL if kept else Ros2Durability.VOLATILE,
        Ros2History.KEEP_ALL if contract.history is History.KEEP_ALL else Ros2History.KEEP_LAST,
        contract.kept if kept else depth if contract.depth is UNSET else contract.depth,
        _nanoseconds(contract.deadline),
        _nanoseconds(contract.lifespan),
        Ros2Liveliness.MANUAL_BY_TOPIC if manual else Ros2Liveliness.AUTOMATIC,
        _nanoseconds(contract.liveliness_lease),
    )


def zenoh_qos(contract: Contract, qos: Ros2Qos) -> ZenohQos:
    """The QoS of its Zenoh publisher, and the bounds of its queue.

    Args:
        contract: The contract.
        qos: What ``ros2_qos`` made of it. What is reliable waits for slow receivers (``BLOCK``), in its queue.
    """
    reliable = qos.reliability is Ros2Reliability.RELIABLE
    return ZenohQos(
        reliable=reliable,
        block=reliable,
        priority=PRIORITIES[contract.priority],
        messages=contract.queue_depth,
        cache=qos.depth if qos.latched else 0,
    )


def _nanoseconds(seconds: float | None) -> int:
    return INFINITE if seconds is None else round(seconds * 1e9)


# Liveliness tokens of ROS 2 over Zenoh. The graph of nodes and endpoints.
#
# Each node and each endpoint of ROS 2 declares a token; what declares none is not seen by ``ros2 topic list``::
#
#     @ros2_lv/<domain>/<zid>/<node id>/<node id>/NN/<enclave>/<namespace>/<node>
#     @ros2_lv/<domain>/<zid>/<node id>/<id>/MP|MS|SS|SC/<enclave>/<namespace>/<node>/<name>/<type>/<hash>/<QoS>
#
# ``zid`` is the Zenoh session. Within a part ``/`` is written as ``%``, and an empty part is ``%``. Data, and calls
# of services, go by the key ``<domain>/<name>/<type>/<hash>``. A subscriber whose type has another hash listens at
# another key: it hears nothing, and is told nothing.


# The first chunk of each token; ``**`` does not match it, as it begins with ``@``.
ADMIN_SPACE: Final = "@ros2_lv"
# What stands for the type hash of distributions that have none, as ROS 2 Humble.
NO_HASH: Final = "TypeHashNotSupported"
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
        return self._head(self.number, EntityKind.NODE)

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
    parts = key.split("/")
    whole = len(key) <= limits.KEY_MAX and len(parts) >= _NODE_PARTS and parts[0] == ADMIN_SPACE and all(parts)
    if not whole or not _WILD.isdisjoint(key):
        raise RemoteProtocolError(f"{key[:120]!r} is not a liveliness token of ROS 2")
    try:
        kind = EntityKind(parts[5])
        domain = _token_number(parts[1], _DOMAIN_MAX)
        session_number, number = (_token_number(part, _ENTITY_ID_MAX) for part in parts[3:5])
    except ValueError as error:
        raise RemoteProtocolError(f"{key[:120]!r} is not a liveliness token of ROS 2: {error}") from None
    enclave, namespace, name = (_demangle(part) for part in parts[6:9])
    if not name or "/" in name:
        raise RemoteProtocolError(f"{key[:120]!r} has no name of a node")
    full = f"{_absolute(namespace)}/{name}" if namespace else f"/{name}"
    node = Ros2Node(domain, parts[2], session_number, full, enclave)
    if kind is EntityKind.NODE:
        return node
    if len(parts) < _ENDPOINT_PARTS:
        raise RemoteProtocolError(f"{key[:120]!r} has {len(parts)} parts; an endpoint's has {_ENDPOINT_PARTS}")
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


def _token_number(text: str, largest: int) -> int:
    if text.isascii() and text.isdigit() and len(text) <= len(str(largest)) and int(text) <= largest:
        return int(text)
    raise ValueError(f"{text[:20]!r} is not a number up to {largest}")


def gid_of(token: str, size: int = 16) -> bytes:
    """The GID of an endpoint: the XXH3-128 of its token, the low half first; longer ones have zeros behind."""
    import xxhash  # noqa: PLC0415 - of the extra "zenoh"

    return int(xxhash.xxh3_128_intdigest(token.encode())).to_bytes(16, "little").ljust(size, b"\0")
