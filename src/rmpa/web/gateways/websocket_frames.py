"""Headers of WebSocket frames (RFC 6455, section 5.2): those that the server writes, and those of a client; no I/O.

The library writes whole frames by joining header and payload, a copy of each image for each client. Here the header
is made alone, and the payload is handed to the transport as it is.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final

_FIN: Final = 0x80
_MASKED: Final = 0x80
_MASK_BYTES: Final = 4
_SHORT: Final = struct.Struct("!BB")
_MIDDLE: Final = struct.Struct("!BBH")
_LONG: Final = struct.Struct("!BBQ")


class Opcode(IntEnum):
    """The kind of a frame."""

    TEXT = 1
    BINARY = 2
    PING = 9
    PONG = 10


class MaskCheck:
    """Finds a frame of a client that is not masked, which the library takes (RFC 6455, section 5.1)."""

    def __init__(self) -> None:
        self._header = bytearray()
        self._payload = 0
        """Bytes of the frame's payload that are still to come, its mask included."""

    def passes(self, data: bytes) -> bool:
        """Take the next bytes of the connection; return whether all frames that begin in them are masked."""
        at, size = 0, len(data)
        while at < size:
            if self._payload:
                taken = min(self._payload, size - at)
                self._payload -= taken
                at += taken
                continue
            self._header.append(data[at])
            at += 1
            if len(self._header) < 2:
                continue
            length = self._header[1]
            if not length & _MASKED:
                return False
            extra = {126: 2, 127: 8}.get(length & ~_MASKED, 0)
            if len(self._header) < 2 + extra:
                continue
            short = length & ~_MASKED
            self._payload = _MASK_BYTES + (int.from_bytes(self._header[2:], "big") if extra else short)
            self._header.clear()
        return True


def frame_header(opcode: Opcode, size: int) -> bytes:
    """The header of one unmasked, unfragmented frame with ``size`` bytes of payload."""
    if size < 126:
        return _SHORT.pack(_FIN | opcode, size)
    if size < 1 << 16:
        return _MIDDLE.pack(_FIN | opcode, 126, size)
    return _LONG.pack(_FIN | opcode, 127, size)
