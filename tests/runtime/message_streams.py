"""Streams of messages with a length in front, which ``tests/runtime/conftest.py`` closes."""

from __future__ import annotations

import socket
from collections.abc import Callable

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.outbox import Outbox
from rmpa.runtime.stream import Stream
from rmpa.runtime.tls import SecureSocket

STREAMS: list[Stream] = []


def close_all(*sockets: socket.socket) -> None:
    """Close the streams of a test, then its sockets."""
    for stream in STREAMS:
        stream.close()
    STREAMS.clear()
    for sock in sockets:
        sock.close()


class End:
    """A stream of messages with a length of 4 bytes in front."""

    def __init__(self, sock: socket.socket, outbox: Outbox | None = None, secure: SecureSocket | None = None) -> None:
        sock.setblocking(False)
        self.got: list[bytes] = []
        self.ends: list[Exception | None] = []
        self.offered: list[int] = []
        self.on_message: Callable[[bytes], None] = self.got.append
        box = Outbox(1 << 20, 1 << 30) if outbox is None else outbox
        self.stream = Stream(sock, on_bytes=self.take, on_close=self.ends.append, outbox=box, secure=secure)
        STREAMS.append(self.stream)

    def take(self, view: memoryview) -> tuple[int, int]:
        self.offered.append(len(view))
        at = 0
        while len(view) - at >= 4:
            size = int.from_bytes(view[at : at + 4], "big")
            if size == 0xFFFFFFFF:
                raise RemoteProtocolError("no such length")
            if len(view) - at - 4 < size:
                return at, 4 + size
            self.on_message(bytes(view[at + 4 : at + 4 + size]))
            at += 4 + size
        return at, 0

    def send(self, data: bytes, key: int = 1) -> int:
        return self.stream.send([len(data).to_bytes(4, "big"), memoryview(data)], key)
