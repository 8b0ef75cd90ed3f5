"""A blocking WebSocket client (RFC 6455) that can skip payloads, so that it costs little beside what it measures."""

from __future__ import annotations

import base64
import os
import socket
import struct
from dataclasses import dataclass
from typing import Final, Self

from lab.bed.processes import BedError, Deadline

TEXT: Final = 1
BINARY: Final = 2
CLOSE: Final = 8
PING: Final = 9
PONG: Final = 10
_SHORT: Final = struct.Struct("!BB")
_CHUNK: Final = 1 << 20
_TIMEOUT: Final = 30.0
"""Seconds for the handshake, and for a frame that a caller waits for."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame of the server; servers of this measurement send no fragments.

    Args:
        opcode: ``TEXT``, ``BINARY`` and so on.
        size: Bytes of the payload.
        payload: All of it, or its beginning where the reader keeps no more.
    """

    opcode: int
    size: int
    payload: bytes


class FrameReader:
    """Cuts a server's bytes into frames."""

    def __init__(self) -> None:
        self.keep: int | None = None
        """Bytes of each payload that are kept; ``None`` for all."""
        self._head = bytearray()
        self._payload = bytearray()
        self._opcode = 0
        self._size = -1
        """Of the payload that is being read; -1 while its header is."""
        self._rest = 0

    def feed(self, data: bytes | memoryview) -> list[Frame]:
        """The frames that end in ``data``."""
        view, found = memoryview(data), []
        at = 0
        while at < len(view):
            if self._size < 0:
                at = self._read_header(view, at)
                if self._size != 0:
                    continue
            take = min(self._rest, len(view) - at)
            wanted = take if self.keep is None else min(take, self.keep - len(self._payload))
            if wanted > 0:
                self._payload += view[at : at + wanted]
            at += take
            self._rest -= take
            if not self._rest:
                found.append(Frame(self._opcode, self._size, bytes(self._payload)))
                self._payload.clear()
                self._size = -1
        return found

    def _read_header(self, view: memoryview, at: int) -> int:
        """Take bytes of a header until it is whole; returns where the payload begins."""
        while at < len(view):
            self._head.append(view[at])
            at += 1
            code = self._head[1] & 0x7F if len(self._head) > 1 else 0
            if len(self._head) == 2 + {126: 2, 127: 8}.get(code, 0):
                self._opcode = self._head[0] & 0x0F
                self._size = code if code < 126 else int.from_bytes(self._head[2:], "big")
                self._rest = self._size
                self._head.clear()
                break
        return at


class WebSocket:
    """One connection; a context manager.

    Args:
        port: Of the server, on this machine.
        path: With the query.
        protocol: The subprotocol that is offered; empty for none.

    Raises:
        BedError: The server refuses.
    """

    def __init__(self, port: int, path: str = "/", protocol: str = "") -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), _TIMEOUT)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._reader = FrameReader()
        self._frames: list[Frame] = []
        self._buffer = memoryview(bytearray(_CHUNK))
        try:
            self._shake_hands(port, path, protocol)
        except BaseException:
            self.socket.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection, without a word."""
        self.socket.close()

    def send(self, data: str | bytes) -> None:
        """Send one frame: text, or bytes as a binary one."""
        payload = data.encode() if isinstance(data, str) else data
        self._send(TEXT if isinstance(data, str) else BINARY, payload)

    def receive(self) -> Frame:
        """The next frame that is no ping, which is answered.

        Raises:
            Deadline: None came in time.
            BedError: The server has closed the connection.
        """
        while True:
            while not self._frames:
                self._frames = self.read()[::-1]
            frame = self._frames.pop()
            if frame.opcode == CLOSE:
                raise BedError(f"the server closed the WebSocket: {frame.payload[2:200]!r}")
            if frame.opcode != PONG:
                return frame

    def keep(self, size: int) -> None:
        """Keep no more than the beginning of each payload from now on."""
        self._reader.keep = size

    def pending(self) -> list[Frame]:
        """The frames that were read and that ``receive`` has not returned yet, oldest first."""
        frames, self._frames = self._frames[::-1], []
        return frames

    def read(self) -> list[Frame]:
        """The frames that end in what the socket has now, pings answered; waits for it if the socket blocks.

        Raises:
            Deadline: Nothing came in time.
            BedError: The server has closed the connection.
        """
        try:
            count = self.socket.recv_into(self._buffer)
        except TimeoutError:
            raise Deadline(f"the web server sent nothing for {_TIMEOUT:g} s") from None
        if not count:
            raise BedError("the server closed the connection")
        frames = self._reader.feed(self._buffer[:count])
        for frame in frames:
            if frame.opcode == PING:
                self._send(PONG, frame.payload[: frame.size])
        return [frame for frame in frames if frame.opcode != PING]

    def _send(self, opcode: int, payload: bytes) -> None:
        size, mask = len(payload), os.urandom(4)
        head = _SHORT.pack(0x80 | opcode, 0x80 | (size if size < 126 else 126 if size < 1 << 16 else 127))
        head += b"" if size < 126 else struct.pack("!H" if size < 1 << 16 else "!Q", size)
        long = int.from_bytes((mask * (size // 4 + 1))[:size], "big")
        self.socket.sendall(head + mask + (int.from_bytes(payload, "big") ^ long).to_bytes(size, "big"))

    def _shake_hands(self, port: int, path: str, protocol: str) -> None:
        lines = [
            f"GET {path} HTTP/1.1",
            f"Host: 127.0.0.1:{port}",
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}",
            "Sec-WebSocket-Version: 13",
            *([f"Sec-WebSocket-Protocol: {protocol}"] if protocol else []),
        ]
        self.socket.sendall("".join(f"{line}\r\n" for line in [*lines, ""]).encode())
        answer = b""
        while b"\r\n\r\n" not in answer:
            part = self.socket.recv(4096)
            if not part:
                raise BedError(f"the server hung up during the handshake: {answer[:200]!r}")
            answer += part
        head, _, rest = answer.partition(b"\r\n\r\n")
        if b" 101 " not in head.split(b"\r\n")[0]:
            raise BedError(f"the server refuses a WebSocket: {answer[:300]!r}")
        self._frames = [frame for frame in self._reader.feed(rest) if frame.opcode != PING][::-1] if rest else []
