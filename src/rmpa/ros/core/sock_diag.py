"""Asks the kernel for TCP ports in state LISTEN (sock_diag(7)).

``/proc/net/tcp`` has them too, but the kernel walks its whole socket table for it: some 10 ms on an ordinary machine,
however few sockets there are, where this takes 0.1 ms.
"""

from __future__ import annotations

import socket
import struct
from typing import Final

_NETLINK_SOCK_DIAG: Final = 4
_BY_FAMILY: Final = 20
_REQUEST_DUMP: Final = 0x301
_ERROR, _DONE = 2, 3
_LISTEN: Final = 1 << 10
_HEADER: Final = struct.Struct("=IHHII")
_REQUEST: Final = struct.Struct("=BBBBI48x")
_FOUND: Final = struct.Struct("=BBBB")
_PORT: Final = struct.Struct("!H")
_BUFFER: Final = 1 << 16
_TIMEOUT: Final = 1.0
"""Seconds for an answer, which arrives at once or never."""


def ask_listening_ports() -> set[int] | None:
    """Listening TCP ports of this network namespace; ``None`` where the kernel does not report them."""
    ports: set[int] = set()
    try:
        with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, _NETLINK_SOCK_DIAG) as sock:
            sock.settimeout(_TIMEOUT)
            for family in (socket.AF_INET, socket.AF_INET6):
                body = _REQUEST.pack(family, socket.IPPROTO_TCP, 0, 0, _LISTEN)
                sock.send(_HEADER.pack(_HEADER.size + len(body), _BY_FAMILY, _REQUEST_DUMP, family, 0) + body)
                while read_ports(sock.recv(_BUFFER), ports):
                    pass
    except (OSError, ValueError):
        return None
    return ports


def read_ports(data: bytes, ports: set[int]) -> bool:
    """Add the ports of one answer; return whether more answers follow.

    Raises:
        ValueError: The answer is an error, or not one to this request.
    """
    while len(data) >= _HEADER.size:
        length, kind, *_ = _HEADER.unpack_from(data)
        if kind == _DONE:
            return False
        if kind != _BY_FAMILY or not _HEADER.size + _FOUND.size + _PORT.size <= length <= len(data):
            raise ValueError(f"an answer of kind {kind} and {length} bytes")
        ports.add(_PORT.unpack_from(data, _HEADER.size + _FOUND.size)[0])
        data = data[length + 3 & ~3 :]
    return True
