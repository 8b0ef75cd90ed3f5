"""Headers of a server's WebSocket frames (RFC 6455, section 5.2); no I/O.

The library writes whole frames by joining header and payload, a copy of each image for each client. Here the header
is made alone, and the payload is handed to the transport as it is.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Final

_FIN: Final = 0x80
_SHORT: Final = struct.Struct("!BB")
_MIDDLE: Final = struct.Struct("!BBH")
_LONG: Final = struct.Struct("!BBQ")


class Opcode(IntEnum):
    """The kind of a frame."""

    TEXT = 1
    BINARY = 2
    PING = 9
    PONG = 10


def frame_header(opcode: Opcode, size: int) -> bytes:
    """The header of one unmasked, unfragmented frame with ``size`` bytes of payload."""
    if size < 126:
        return _SHORT.pack(_FIN | opcode, size)
    if size < 1 << 16:
        return _MIDDLE.pack(_FIN | opcode, 126, size)
    return _LONG.pack(_FIN | opcode, 127, size)
