"""Last values of topics, which a gateway keeps for when a module is off. Without I/O.

``get`` on ``rmpa/1/<site>/<module>/v/<topic>`` (wildcards allowed) brings the last message of each publisher as its
topic does: the payload is the TCPROS message, the attachment that of ``sites.attachment``. With the parameter
``header`` the payload is what a program needs to read it, and not the message::

    {"node": "/map_server", "type": "nav_msgs/OccupancyGrid", "md5sum": "…", "definition": "…", "latching": true,
     "stamp": 1700000000000000000, "size": 16000076}
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.names import is_global_name, is_type_name
from rmpa.gateway import limits
from rmpa.gateway.sites.keys import ROOT

if TYPE_CHECKING:
    from rmpa.ros.wire.tcpros import Buffer

HEADER: Final = "header"
"""The parameter of a query for the headers."""
_DESCRIPTOR: Final = "/descriptor"
_TEXT: Final = "std_msgs/String"
_STREAMS: Final = frozenset(
    (
        "sensor_msgs/Image",
        "sensor_msgs/CompressedImage",
        "sensor_msgs/PointCloud",
        "sensor_msgs/PointCloud2",
        "sensor_msgs/LaserScan",
        "stereo_msgs/DisparityImage",
    )
)
"""Types of streams: their publishers are not asked whether they latch, since a driver may start by being asked."""


@dataclass(frozen=True, slots=True)
class ValueKey:
    """Which value: the last one of one publisher.

    Args:
        module: The module, of the gateway's site.
        topic: The topic in the module's graph.
        node: Its publisher there.
    """

    module: str
    topic: str
    node: str


@dataclass(frozen=True, slots=True)
class LastValue:
    """The last message of a publisher.

    Args:
        type: ``package/Name``.
        md5sum: 32 hexadecimal digits.
        definition: The publisher's; may be empty.
        latching: Whether the publisher is latched.
        stamp: When the gateway received it, nanoseconds since 1970.
        body: The TCPROS message without its length.
    """

    type: str
    md5sum: str
    definition: str
    latching: bool
    stamp: int
    body: bytes


class ValueHeader(msgspec.Struct, frozen=True, kw_only=True):
    """All of a last value but its message; the reply to a query with ``header``."""

    node: str
    type: str
    md5sum: str
    definition: str = ""
    latching: bool = False
    stamp: int = 0
    size: int = 0

    def serialize(self) -> bytes:
        """As JSON."""
        return msgspec.json.encode(self)

    @classmethod
    def parse(cls, data: Buffer) -> ValueHeader:
        """Read one.

        Raises:
            RemoteProtocolError: It is none, or names a node or a type that ROS does not allow.
        """
        if len(data) > limits.VALUE_HEADER_MAX:
            raise RemoteProtocolError(f"the header of a last value has {len(data)} bytes")
        try:
            found = msgspec.json.decode(data, type=cls)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise RemoteProtocolError(f"not the header of a last value: {error}") from None
        if not is_global_name(found.node) or not is_type_name(found.type):
            raise RemoteProtocolError(f"the last value of {found.node[:80]!r} is a {found.type[:80]!r}")
        return found


def value_key(site: str, module: str, topic: str) -> str:
    """The key of a last value; ``*`` may stand for the module, ``**`` for the topic."""
    return f"{ROOT}/{site}/{module}/v/{topic.strip('/')}"


def parse_value_key(key: str) -> tuple[str, str, str]:
    """Site, module and topic of a key.

    Raises:
        RemoteProtocolError: It is not the key of a last value.
    """
    chunks = key.split("/")
    if len(key) > limits.KEY_MAX or len(chunks) < 6 or "/".join(chunks[:2]) != ROOT or chunks[4] != "v":
        raise RemoteProtocolError(f"{key[:120]!r} is not the key of a last value")
    return chunks[2], chunks[3], "/" + "/".join(chunks[5:])


def is_descriptor(topic: str, type_name: str) -> bool:
    """Whether a topic has the descriptor of a Smart Resource; such a topic is always kept."""
    return topic.endswith(_DESCRIPTOR) and type_name == _TEXT


def may_be_latched(type_name: str) -> bool:
    """Whether the publisher of a topic is asked if it latches."""
    return type_name not in _STREAMS


def fits(pattern: str, key: str) -> bool:
    """Whether a key is one of those that a key expression means; ``$*`` within a chunk is not understood."""

    def match(wanted: list[str], has: list[str]) -> bool:
        if not wanted:
            return not has
        if wanted[0] == "**":
            return any(match(wanted[1:], has[skip:]) for skip in range(len(has) + 1))
        return bool(has) and wanted[0] in ("*", has[0]) and match(wanted[1:], has[1:])

    if "**" not in pattern and "*" not in pattern:
        return pattern == key
    chunks = pattern.split("/")
    return chunks.count("**") <= 1 and match(chunks, key.split("/"))
