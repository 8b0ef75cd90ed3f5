"""Clients of a web server that subscribe to one topic, as a process of its own; some may stop reading.

Events: ``up`` when all have subscribed; ``counted`` with, for each client that reads, how many messages of the round
came, how many came out of order or twice, the bytes of its frames, and the median of its latencies in ns from when
the messages were due. Reads lines ``ROUND SETTLE``: counts that round from now on, and tells it when nothing has come
for SETTLE seconds; with SETTLE 0 it only counts, and says ``counting``.
"""

from __future__ import annotations

import argparse
import os
import selectors
import statistics
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from lab.nodes.node import say
from lab.web.subscriptions import HOWS, KEPT, head_of, protocol_of, subscribe
from lab.web.websocket import TEXT, WebSocket

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lab.web.subscriptions import How
    from lab.web.websocket import Frame

_STDIN: Final = 0
_LOOK: Final = 0.05
"""Seconds between looks whether nothing comes any more."""
_FIRST_TEXT: Final = 300
"""Characters of a text that a server sends in place of a message; it is shown."""


@dataclass(eq=False)
class Client:
    """One client that reads.

    Args:
        socket: Its connection.
        how: Its protocol and encoding.
    """

    socket: WebSocket
    how: How
    round: int = 0
    bytes: int = 0
    last: int = -1
    unordered: int = 0
    latencies: list[int] = field(default_factory=list)

    def begin(self, number: int) -> None:
        """Count another round."""
        self.round, self.bytes, self.last, self.unordered = number, 0, -1, 0
        self.latencies.clear()

    def take(self, frames: Sequence[Frame]) -> bool:
        """Count the messages of the round; returns whether there were any."""
        before = len(self.latencies)
        for frame in frames:
            now = time.monotonic_ns()
            head = head_of(frame, self.how)
            if head is None:
                if frame.opcode == TEXT and b'"status"' in frame.payload:
                    print(frame.payload[:_FIRST_TEXT].decode(errors="replace"), flush=True)
            elif head[0] == self.round:
                self.unordered += head[1] <= self.last
                self.last = head[1]
                self.bytes += frame.size
                self.latencies.append(now - head[2])
        return len(self.latencies) > before

    def told(self) -> dict[str, float]:
        """What came, for the event."""
        middle = statistics.median(self.latencies) if self.latencies else 0.0
        return {
            "count": len(self.latencies),
            "unordered": self.unordered,
            "bytes": self.bytes,
            "latency_ns": middle,
        }


class Readers:
    """All clients that read, in one thread."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._selector.register(_STDIN, selectors.EVENT_READ)
        self._clients: list[Client] = []
        self._settle = 0.0
        self._last = 0.0
        self._typed = b""

    def add(self, client: Client) -> None:
        """Read what comes for this client from now on."""
        client.take(client.socket.pending())
        self._selector.register(client.socket.socket, selectors.EVENT_READ, client)
        self._clients.append(client)

    def run(self) -> None:
        """Read until the standard input ends."""
        while True:
            for key, _ in self._selector.select(_LOOK if self._settle else None):
                if key.data is None:
                    if not self._command():
                        return
                elif key.data.take(key.data.socket.read()):
                    self._last = time.monotonic()
            if self._settle and time.monotonic() - self._last > self._settle:
                self._settle = 0.0
                say("counted", clients=[client.told() for client in self._clients])

    def _command(self) -> bool:
        part = os.read(_STDIN, 4096)
        *lines, self._typed = (self._typed + part).split(b"\n")
        for line in lines:
            number, settle = line.split()
            if self._clients and int(number) != self._clients[0].round:
                for client in self._clients:
                    client.begin(int(number))
            self._settle, self._last = float(settle), time.monotonic()
            if not self._settle:
                say("counting", round=int(number))
        return bool(part)


def main() -> None:
    """Run until the standard input ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--path", default="/")
    parser.add_argument("--how", choices=HOWS, required=True)
    parser.add_argument("--topic", required=True)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--stalled", type=int, default=0, help="further clients that subscribe and never read")
    given = parser.parse_args()
    readers, kept = Readers(), []
    for number in range(given.count + given.stalled):
        socket = WebSocket(given.port, given.path, protocol_of(given.how))
        subscribe(socket, given.how, given.topic)
        socket.keep(KEPT)
        if number < given.count:
            readers.add(Client(socket, given.how))
        else:
            kept.append(socket)
    say("up")
    readers.run()


if __name__ == "__main__":
    main()
