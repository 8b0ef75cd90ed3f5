"""The attachment of each message between sites.

Little-endian::

     0 version    1 byte    1
     1 flags      1 byte    bit 0: latched
     2 sequence   8 bytes   counts the messages of a source, from 1: a gap is a loss
    10 stamp      8 bytes   when its gateway received it, nanoseconds since 1970; signed
    18 md5       16 bytes   the md5 sum of the message type
    34 node       1 + n     its publisher, UTF-8
     … path       1         sites that it passed, each 1 + n bytes of UTF-8, the first one is its origin

The md5 sum is here and not in the key, because a gateway knows it only once a node has subscribed.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import peer_name_problem
from rmpa.core.names import is_global_name
from rmpa.gateway import limits

if TYPE_CHECKING:
    from rmpa.ros.wire.tcpros import Buffer

VERSION: Final = 1
_LATCHED: Final = 1
_HEAD: Final = struct.Struct("<BBQq16s")


@dataclass(frozen=True, slots=True)
class SiteAttachment:
    """What goes with a message between sites.

    Args:
        sequence: The number of the message at its source, from 1.
        stamp: When its gateway received it, in nanoseconds since 1970.
        md5: The md5 sum of its type, 32 hexadecimal digits.
        node: Its publisher, ``/like/this``.
        path: The sites that it passed, its origin first; at most ``limits.PATH_MAX``.
        latched: Whether its publisher is latched.
    """

    sequence: int
    stamp: int
    md5: str
    node: str
    path: tuple[str, ...]
    latched: bool = False

    def serialize(self) -> bytes:
        """The bytes of the attachment."""
        flags = _LATCHED if self.latched else 0
        head = _HEAD.pack(VERSION, flags, self.sequence, self.stamp, bytes.fromhex(self.md5))
        return b"".join((head, _text(self.node), bytes([len(self.path)]), *map(_text, self.path)))

    @classmethod
    def parse(cls, data: Buffer) -> SiteAttachment:
        """Read an attachment; bytes behind the path are ignored, so that later versions may add to it.

        Raises:
            RemoteProtocolError: It is shorter than it says, of another version, or has a name that is none in ROS.
        """
        raw = memoryview(data)
        if len(raw) < _HEAD.size:
            raise RemoteProtocolError(f"an attachment of a site has {len(raw)} bytes; the least are {_HEAD.size + 2}")
        version, flags, sequence, stamp, md5 = _HEAD.unpack_from(raw)
        if version != VERSION:
            raise RemoteProtocolError(
                f"an attachment of a site is of version {version}; this gateway reads {VERSION}"
            )
        node, at = _read(raw, _HEAD.size)
        if not is_global_name(node):
            raise RemoteProtocolError(f"an attachment of a site has the node {node[:80]!r}, which is no global name")
        if at >= len(raw):
            raise RemoteProtocolError("an attachment of a site ends before its path")
        count, at = raw[at], at + 1
        if not 0 < count <= limits.PATH_MAX:
            raise RemoteProtocolError(f"a message passed {count} sites; 1 to {limits.PATH_MAX} are allowed")
        path = []
        for _ in range(count):
            site, at = _read(raw, at)
            if peer_name_problem(site) is not None:
                raise RemoteProtocolError(f"an attachment of a site names the site {site[:80]!r}")
            path.append(site)
        return cls(sequence, stamp, md5.hex(), node, tuple(path), bool(flags & _LATCHED))


def _text(text: str) -> bytes:
    raw = text.encode()
    return bytes([len(raw)]) + raw


def _read(raw: memoryview, at: int) -> tuple[str, int]:
    end = at + 1 + raw[at] if at < len(raw) else len(raw) + 1
    if end > len(raw):
        raise RemoteProtocolError("an attachment of a site ends within a name")
    try:
        return str(raw[at + 1 : end], "utf-8"), end
    except UnicodeDecodeError as error:
        raise RemoteProtocolError(f"an attachment of a site has a name that is not UTF-8: {error}") from error
