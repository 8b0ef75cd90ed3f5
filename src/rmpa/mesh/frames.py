"""Frames: the units of a connection's byte stream (docs/design/protocol.md, "Frames").

``Frame`` is the readable form, for all frames that are rare. The data path packs headers by ``pack_data_header`` and
``pack_fragment_header``, reads them by ``unpack_header``, and makes no objects.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

from rmpa.core.errors import LimitExceeded, LocalProtocolError, RemoteProtocolError
from rmpa.core.identity import SERIAL_MASK
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.mesh import limits

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rmpa.core.outbox import QueuedMessage

Buffer = bytes | bytearray | memoryview

_HEADER: Final = struct.Struct(">IBBHIIQ")
_STAMPS: Final = struct.Struct(">QQ")

unpack_header: Final = _HEADER.unpack_from
"""``(view, offset)`` to ``(length, kind, flags, reserved, route, sequence, stamp_ns)``, unchecked."""

_pack: Final = _HEADER.pack

WHOLE: Final = FIRST | LAST
"""The flags of a message in one piece."""


class FrameKind(IntEnum):
    """Kinds of frames."""

    HELLO = 1
    WELCOME = 2
    REFUSE = 3
    PING = 4
    PONG = 5
    CONTROL = 6
    DATA = 7
    BYE = 8
    ACK = 9
    FENCE = 10
    FENCED = 11
    PACE = 12
    LANE = 13


class PaceFlag(IntFlag):
    """What the route field of a pace frame says; bits that are not known are ignored."""

    NEEDED = 1
    """Something at the sender depends on the connection, so that neither side may rest."""


PAYLOAD_MAX: Final[Mapping[int, int]] = MappingProxyType(
    {
        FrameKind.HELLO: limits.HELLO_PAYLOAD_MAX,
        FrameKind.WELCOME: limits.HELLO_PAYLOAD_MAX,
        FrameKind.REFUSE: limits.HELLO_PAYLOAD_MAX,
        FrameKind.PING: 0,
        FrameKind.PONG: _STAMPS.size,
        FrameKind.CONTROL: limits.CONTROL_PAYLOAD_MAX,
        FrameKind.DATA: limits.DATA_PAYLOAD_MAX,
        FrameKind.BYE: limits.HELLO_PAYLOAD_MAX,
        FrameKind.ACK: 0,
        FrameKind.FENCE: 0,
        FrameKind.FENCED: 0,
        FrameKind.PACE: 0,
        FrameKind.LANE: 0,
    }
)
"""The most bytes of payload that a frame of each kind may claim."""


def pack_data_header(length: int, route: int, sequence: int, stamp_ns: int) -> bytes:
    """The 24 bytes in front of a whole message of ``length`` bytes.

    Raises:
        LocalProtocolError: The message is longer than a frame carries, or a number does not fit its field.
    """
    if length > limits.DATA_PAYLOAD_MAX:
        raise LocalProtocolError(f"a message of {length} bytes exceeds a frame's {limits.DATA_PAYLOAD_MAX}")
    try:
        return _pack(length, 7, 3, 0, route, sequence & SERIAL_MASK, stamp_ns)
    except struct.error as error:
        raise LocalProtocolError(f"route {route} or stamp {stamp_ns} does not fit its field: {error}") from None


def pack_fragment_header(parcel: QueuedMessage, length: int, flags: int) -> bytes:
    """The 24 bytes in front of a fragment of ``length`` bytes; the parcel's key is the route."""
    return _pack(length, 7, flags, 0, parcel.key, parcel.sequence & SERIAL_MASK, parcel.stamp_ns)


def check_header(length: int, kind: int, flags: int) -> None:
    """Check what a header claims, before anything of its payload is stored.

    Raises:
        LimitExceeded: The length is beyond what this kind may have.
        RemoteProtocolError: The kind is unknown, or the flags are not possible.
    """
    limit = PAYLOAD_MAX.get(kind)
    if limit is None:
        raise RemoteProtocolError(f"frame of unknown kind {kind}")
    if length > limit:
        raise LimitExceeded(f"{FrameKind(kind).name.lower()} frame", length, limit)
    if kind != FrameKind.DATA:
        if flags & WHOLE != WHOLE:
            raise RemoteProtocolError(
                f"{FrameKind(kind).name.lower()} frame is a fragment; only data comes in fragments"
            )
    elif flags & ABORT:
        if length or flags & WHOLE != LAST:
            raise RemoteProtocolError(f"data frame that aborts its message has {length} bytes, flags {flags:#x}")
    elif not length:
        raise RemoteProtocolError("data frame without data")


@dataclass(frozen=True, slots=True)
class Frame:
    """One whole frame.

    Args:
        kind: Its kind.
        payload: Its bytes; what they mean depends on the kind.
        route: Data only: the route's id, 32 bits.
        sequence: Data only: counts the messages of the route, 32 bits.
        stamp_ns: The sender's wall clock, or for data the time of publication; 64 bits.
        flags: ``FIRST`` and ``LAST``; both on a whole message.
    """

    kind: FrameKind
    payload: bytes = b""
    route: int = 0
    sequence: int = 0
    stamp_ns: int = 0
    flags: int = WHOLE

    @classmethod
    def parse(cls, data: Buffer) -> tuple[Frame, int] | None:
        """Read the frame at the start of ``data``.

        Returns:
            The frame and how many bytes it took; ``None`` while it is not complete.

        Raises:
            RemoteProtocolError: Its header claims what is not allowed; raised as soon as the header is complete.
        """
        if len(data) < limits.FRAME_HEADER_BYTES:
            return None
        length, kind, flags, _, route, sequence, stamp_ns = unpack_header(data, 0)
        check_header(length, kind, flags)
        end = limits.FRAME_HEADER_BYTES + length
        if len(data) < end:
            return None
        payload = bytes(data[limits.FRAME_HEADER_BYTES : end])
        return cls(FrameKind(kind), payload, route, sequence, stamp_ns, flags), end

    def serialize(self) -> bytes:
        """The bytes on the wire.

        Raises:
            LocalProtocolError: The payload is longer than this kind allows.
        """
        if len(self.payload) > PAYLOAD_MAX[self.kind]:
            limit = PAYLOAD_MAX[self.kind]
            raise LocalProtocolError(f"{self.kind.name} payload of {len(self.payload)} bytes exceeds {limit}")
        header = _pack(len(self.payload), self.kind, self.flags, 0, self.route, self.sequence, self.stamp_ns)
        return header + self.payload

    def __str__(self) -> str:
        """``DATA route=7 #12 1048580 bytes``; never the payload."""
        parts = [self.kind.name]
        if self.kind is FrameKind.DATA:
            parts.append(f"route={self.route} #{self.sequence}")
        if self.flags & WHOLE != WHOLE:
            parts.append(f"flags={self.flags}")
        if self.payload:
            parts.append(f"{len(self.payload)} bytes")
        return " ".join(parts)


def pong(ping_stamp_ns: int, came_ns: int, stamp_ns: int) -> Frame:
    """The answer to a ping: its stamp (t1), when it came (t2), and now (t3)."""
    return Frame(FrameKind.PONG, _STAMPS.pack(ping_stamp_ns, came_ns), stamp_ns=stamp_ns)


def parse_pong(payload: Buffer) -> tuple[int, int]:
    """Read t1 and t2, in ns, from a pong's payload.

    Raises:
        RemoteProtocolError: It does not have 16 bytes.
    """
    if len(payload) != _STAMPS.size:
        raise RemoteProtocolError(f"pong of {len(payload)} bytes; it has {_STAMPS.size}")
    t1, t2 = _STAMPS.unpack(payload)
    return t1, t2


def bye(reason: str, *, stamp_ns: int = 0) -> Frame:
    """The last frame of a connection."""
    return Frame(FrameKind.BYE, text_payload(reason), stamp_ns=stamp_ns)


def text_payload(text: str) -> bytes:
    """Text for a refuse or bye frame, cut at what such a frame may carry."""
    return text.encode("utf-8", "replace")[: limits.HELLO_PAYLOAD_MAX - 2]


def parse_text(payload: Buffer) -> str:
    """The text of a refuse or bye frame, safe for a log: one line, nothing unprintable."""
    text = bytes(payload).decode("utf-8", "replace")
    return "".join(c if c.isprintable() else " " for c in text)[:512]
