"""A connected TCP socket that sends in small segments, whatever path MTU the kernel assumes."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rmpa.runtime.buffers import Buffer


class SegmentedSocket:
    """Sends in pieces that the kernel neither joins nor sends as one large packet (MSG_EOR).

    TCP_MAXSEG cannot do this: it has no effect on a connected socket, and where the network interface is expected to
    segment by itself (a virtual one never does), several segments still leave the machine as one packet. This class
    makes one system call for each segment, so it is only for connections that need it.

    Args:
        sock: Connected, non-blocking.
        size: Bytes in one segment.
    """

    def __init__(self, sock: socket.socket, size: int) -> None:
        self._sock = sock
        self.size = size
        self._begun = 0
        """Bytes that the socket took of a piece, if it took only a part: the next bytes join the same packet."""

    def sendmsg(self, parts: Sequence[Buffer]) -> int:
        """Send as much as the socket takes now; return the number of bytes.

        Raises:
            BlockingIOError: The socket's buffer is full.
            OSError: The connection is gone.
        """
        sent = 0
        for piece, size in self._pieces(parts):
            try:
                took = self._sock.sendmsg(piece, (), socket.MSG_EOR)
            except OSError:
                if sent:
                    return sent  # the next call raises the error again
                raise
            sent += took
            if took < size:
                self._begun += took
                return sent
            self._begun = 0
        return sent

    def _pieces(self, parts: Sequence[Buffer]) -> Iterator[tuple[list[Buffer], int]]:
        """The pieces, each a list of views and its size; the first completes a piece that was sent in part."""
        if self._begun >= self.size:  # the size was reduced below the bytes taken: that packet takes no more bytes
            self._begun = 0
        room = self.size - self._begun
        piece: list[Buffer] = []
        filled = 0
        for part in parts:
            view = memoryview(part)
            start = 0
            while start < len(view):
                cut = view[start : start + room - filled]
                piece.append(cut)
                filled += len(cut)
                start += len(cut)
                if filled == room:
                    yield piece, filled
                    piece, filled, room = [], 0, self.size
        if piece:
            yield piece, filled

    def segment(self, size: int) -> None:
        """Send in segments of ``size`` bytes from now on."""
        self.size = size

    def recv_into(self, buffer: memoryview) -> int:
        """Read into a buffer, as ``socket.recv_into``."""
        return self._sock.recv_into(buffer)

    def shutdown(self, how: int) -> None:
        """Close one direction, as ``socket.shutdown``."""
        self._sock.shutdown(how)

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()
