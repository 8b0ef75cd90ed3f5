"""Fuzz target: the kernel's answers about TCP sockets; another kernel, or an emulated one, may answer anything."""

from __future__ import annotations

import struct

from rmpa.runtime.kernel_tcp import TcpSocket, destroy_query, read_answer

_HEADER = struct.Struct("=IHHII")


def _answer(kind: int, flags: int, body: bytes) -> bytes:
    return _HEADER.pack(_HEADER.size + len(body), kind, flags, 0, 0) + body


_FOUND = _answer(20, 2, bytes([2, 1, 0, 0]) + bytes(range(48)) + bytes(20))
_INFO = struct.pack("=HH", 4 + 136, 2) + bytes(120) + struct.pack("=QQ", 1 << 40, 7)
SEEDS: list[bytes] = [
    b"",
    _answer(20, 2, _FOUND[16:] + _INFO),
    _FOUND,
    _FOUND + _FOUND + _answer(3, 2, bytes(4)),
    _answer(2, 0, struct.pack("=i", -1) + bytes(16)),
    _answer(2, 0, bytes(20)),
    _answer(2, 0, struct.pack("=i", -(1 << 31)) + bytes(16)),
    _answer(20, 0x12, bytes(72)),
    _answer(1, 0, b"") + _answer(3, 2, b""),
]


def fuzz(data: bytes) -> None:
    """Whole sockets, or a documented error that is safe to log."""
    found: list[bytes] = []
    try:
        read_answer(data, found, 0)
    except ValueError as error:
        if not str(error).isprintable():
            raise AssertionError("an error's text is not safe to log") from error
    except OSError as error:
        if not error.errno:
            raise AssertionError("an error without its number") from error
    for body in found:
        if destroy_query(TcpSocket.parse(body))[8:] != body[4:52]:
            raise AssertionError("a part of a socket was taken for the whole")
