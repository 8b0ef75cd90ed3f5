"""The attachment of each message between sites.

Little-endian::

     0 version    1 byte    1
     1 flags      1 byte    bit 0: latched
     2 sequence   8 bytes   counts the messages of a source, from 1: a gap is a loss
    10 stamp      8 bytes   when its gateway received it, nanoseconds since 1970; signed
    18 md5       16 bytes   the md5 sum of the message type
    34 node       1 + n     its publisher, UTF-8
     … path       1         sites that it passed, each 1 + n bytes of UTF-8, the first one is its origin
     … run        8 bytes   the run of its exporter, in which the sequence counts from 1; may be missing

The md5 sum is here and not in the key, because a gateway knows it only once a node has subscribed.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import is_global_name, peer_name_problem
from rmpa.gateway import limits

if TYPE_CHECKING:
    from rmpa.ros.wire.tcpros import Buffer

VERSION: Final = 1
_LATCHED: Final = 1
_HEAD: Final = struct.Struct("<BBQq16s")
_RUN: Final = struct.Struct("<Q")
_NUMBERS: Final = struct.Struct("<Qq")
_COMMON: Final = 18
"""From here on, and before the numbers, all attachments of one source are the same."""
_SOURCES_KEPT: Final = 256
"""Sources that a reader remembers; then it begins anew."""


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
        run: The run of its exporter, by which sequence numbers are told apart; 0: not told.
    """

    sequence: int
    stamp: int
    md5: str
    node: str
    path: tuple[str, ...]
    latched: bool = False
    run: int = 0

    def serialize(self) -> bytes:
        """The bytes of the attachment."""
        writer = AttachmentWriter(self.md5, self.node, self.path, latched=self.latched, run=self.run)
        return writer.write(self.sequence, self.stamp)

    @classmethod
    def parse(cls, data: Buffer) -> SiteAttachment:
        """Read an attachment; bytes behind the run are ignored, so that later versions may add to it.

        Raises:
            RemoteProtocolError: It is shorter than it says, of another version, or has a name that is none in ROS.
        """
        sequence, stamp, source = AttachmentReader().read(bytes(data))
        return cls(sequence, stamp, source.md5, source.node, source.path, source.latched, source.run)


class AttachmentWriter:
    """Writes the attachments of one source; all but sequence and stamp is made once.

    Args:
        md5: The md5 sum of its type, 32 hexadecimal digits.
        node: Its publisher.
        path: The sites that its messages passed, with this one.
        latched: Whether its publisher is latched.
        run: The run of its exporter; 0: not told.
    """

    def __init__(self, md5: str, node: str, path: tuple[str, ...], *, latched: bool = False, run: int = 0) -> None:
        self._flags = _LATCHED if latched else 0
        self._md5 = bytes.fromhex(md5)
        told = _RUN.pack(run) if run else b""
        self._tail = b"".join((_text(node), bytes([len(path)]), *map(_text, path), told))

    def write(self, sequence: int, stamp: int) -> bytes:
        """The attachment of one message."""
        return _HEAD.pack(VERSION, self._flags, sequence, stamp, self._md5) + self._tail


@dataclass(frozen=True, slots=True)
class MessageSource:
    """What the attachments of one source have in common; the fields are those of ``SiteAttachment``."""

    md5: str
    node: str
    path: tuple[str, ...]
    latched: bool
    run: int


class AttachmentReader:
    """Reads the attachments of sources; what is the same in all of one source's is read once."""

    def __init__(self) -> None:
        self._known: dict[bytes, MessageSource] = {}

    def read(self, data: bytes) -> tuple[int, int, MessageSource]:
        """Read an attachment; bytes behind the run are ignored, so that later versions may add to it.

        Returns:
            The sequence, the stamp, and the source.

        Raises:
            RemoteProtocolError: It is shorter than it says, of another version, or has a name that is none in ROS.
        """
        if len(data) < _HEAD.size:
            raise RemoteProtocolError(
                f"an attachment of a site has {len(data)} bytes; the least are {_HEAD.size + 2}"
            )
        common = data[:2] + data[_COMMON:]
        source = self._known.get(common)
        if source is None:
            source = _read_source(data)
            if len(self._known) >= _SOURCES_KEPT:
                self._known.clear()
            self._known[common] = source
        sequence, stamp = _NUMBERS.unpack_from(data, 2)
        return sequence, stamp, source


def _read_source(data: bytes) -> MessageSource:
    version, flags, _, _, md5 = _HEAD.unpack_from(data)
    if version != VERSION:
        raise RemoteProtocolError(f"an attachment of a site is of version {version}; this gateway reads {VERSION}")
    node, path, run = _read_tail(data[_HEAD.size :])
    return MessageSource(md5.hex(), node, path, bool(flags & _LATCHED), run)


def _read_tail(tail: bytes) -> tuple[str, tuple[str, ...], int]:
    """Node, path and run."""
    raw = memoryview(tail)
    node, at = _read(raw, 0)
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
    run = _RUN.unpack_from(raw, at)[0] if len(raw) >= at + _RUN.size else 0
    return node, tuple(path), run


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
