"""The format of zenoh-bridge-ros1 (eclipse-zenoh/zenoh-plugin-ros1), for fleets that have both.

Messages go without their length, by the key ``<type>/<md5>/<namespace>/<topic>``; presence is an empty put a second
at ``ros1_discovery_info/<discovery namespace>/<kind>/<type>/<md5>/<namespace>/<topic>``. The type is written as the
hexadecimal digits of its ROS name. Its weaknesses are the format's: no definitions, no latching, and a service that
fails is answered as one that succeeded.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.names import is_global_name, is_type_name
from rmpa.gateway import limits

DISCOVERY: Final = "ros1_discovery_info"
"""The first chunk of the keys of presence."""
PRESENCE_PERIOD: Final = 1.0
"""Seconds between two puts of presence."""
ANY_NAMESPACE: Final = "*"
"""The bridge's namespace by default."""
_MD5: Final = re.compile(r"[0-9a-f]{32}|\*")


class BridgedKind(StrEnum):
    """What is announced; the value is its chunk in the key."""

    PUBLISHER = "pub"
    SUBSCRIBER = "sub"
    SERVICE = "srv"
    CLIENT = "cl"


@dataclass(frozen=True, slots=True)
class BridgedTopic:
    """A topic or a service of zenoh-bridge-ros1.

    Args:
        name: ``/like/this``.
        type: ``package/Name``; ``*`` if the bridge does not know it.
        md5: The md5 sum; ``*`` likewise.
        namespace: The bridge's namespace.
    """

    name: str
    type: str
    md5: str
    namespace: str = ANY_NAMESPACE

    def key(self) -> str:
        """The key of its messages or calls."""
        kind = self.type if self.type == "*" else self.type.encode().hex()
        return f"{kind}/{self.md5}/{self.namespace}/{self.name.strip('/')}"

    def presence(self, kind: BridgedKind, discovery: str = ANY_NAMESPACE) -> str:
        """The key of its presence.

        Args:
            kind: What is present.
            discovery: The bridge's namespace of discovery.
        """
        return f"{DISCOVERY}/{discovery}/{kind}/{self.key()}"


def parse_presence(key: str) -> tuple[BridgedKind, BridgedTopic]:
    """Read a key of presence.

    Raises:
        RemoteProtocolError: It has another form, or a name that ROS does not allow.
    """
    chunks = key.split("/")
    if len(key) > limits.KEY_MAX or len(chunks) < 7 or chunks[0] != DISCOVERY:
        raise RemoteProtocolError(f"{key[:120]!r} is not a presence of zenoh-bridge-ros1")
    try:
        kind = BridgedKind(chunks[2])
    except ValueError:
        raise RemoteProtocolError(f"{key[:120]!r}: {chunks[2][:20]!r} is no kind of entity") from None
    return kind, _topic(chunks[3:], key)


def parse_key(key: str) -> BridgedTopic:
    """Read a key of messages.

    Raises:
        RemoteProtocolError: It has another form, or a name that ROS does not allow.
    """
    chunks = key.split("/")
    if len(key) > limits.KEY_MAX or len(chunks) < 4:
        raise RemoteProtocolError(f"{key[:120]!r} is not a key of zenoh-bridge-ros1")
    return _topic(chunks, key)


def _topic(chunks: list[str], key: str) -> BridgedTopic:
    coded, md5, namespace = chunks[:3]
    try:
        kind = coded if coded == "*" else bytes.fromhex(coded).decode("ascii")
    except ValueError:
        raise RemoteProtocolError(f"{key[:120]!r}: {coded[:40]!r} is not a type in hexadecimal digits") from None
    name = "/" + "/".join(chunks[3:])
    if (kind != "*" and not is_type_name(kind)) or not _MD5.fullmatch(md5) or not is_global_name(name):
        raise RemoteProtocolError(f"{key[:120]!r} has no type, md5 sum and name of ROS")
    return BridgedTopic(name, kind, md5, namespace)
