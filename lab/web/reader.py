"""Clients of a web server that subscribe to one topic, as a process of its own; some may stop reading.

Events: ``up`` when all have subscribed; ``counted`` with, for each client that reads, how many messages of the round
came, how many came out of order or twice, and the median of its latencies in ns from when the messages were due.
Reads lines ``ROUND SETTLE``: counts that round from now on, and tells it when nothing has come for SETTLE seconds;
with SETTLE 0 it only counts, and says ``counting``.
"""

from __future__ import annotations

import argparse
import statistics
import threading
import time
from typing import Final

from lab.bed.processes import BedError
from lab.nodes.node import commands, say
from lab.web.subscriptions import HOWS, How, head_of, protocol_of, subscribe
from lab.web.websocket import WebSocket

# Seconds between looks whether nothing comes any more.
_LOOK: Final = 0.05
# Characters of a text that a server sends in place of a message; it is shown.
_FIRST_TEXT: Final = 300


class Client:
    """One client that reads, in a thread of its own.

    Args:
        socket: Its connection, subscribed.
        how: Its protocol and encoding.
    """

    def __init__(self, socket: WebSocket, how: How) -> None:
        self._socket, self._how = socket, how
        self.begin(0)
        threading.Thread(target=self._read, daemon=True).start()

    def begin(self, number: int) -> None:
        """Count another round."""
        self._latencies: list[int] = []
        self.round, self.came, self._last, self._unordered = number, time.monotonic(), -1, 0

    def _read(self) -> None:
        while True:
            try:
                message = self._socket.receive(None)
            except BedError:
                return
            now = time.monotonic_ns()
            head = head_of(message, self._how)
            if head is None:
                if isinstance(message, str) and '"status"' in message[:_FIRST_TEXT]:
                    print(message[:_FIRST_TEXT], flush=True)
            elif head[0] == self.round:
                self._unordered += head[1] <= self._last
                self._last = head[1]
                self._latencies.append(now - head[2])
                self.came = time.monotonic()

    def told(self) -> dict[str, float]:
        """What came, for the event."""
        middle = statistics.median(self._latencies) if self._latencies else 0.0
        return {"count": len(self._latencies), "unordered": self._unordered, "latency_ns": middle}


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
    sockets = [WebSocket(given.port, given.path, protocol_of(given.how)) for _ in range(given.count + given.stalled)]
    for socket in sockets:
        subscribe(socket, given.how, given.topic)
    clients = [Client(socket, given.how) for socket in sockets[: given.count]]
    say("up")
    for number, settle in commands():
        for client in clients:
            if client.round != int(number):
                client.begin(int(number))
        if not float(settle):
            say("counting", round=int(number))
            continue
        asked = time.monotonic()
        while time.monotonic() - max(asked, *(client.came for client in clients)) < float(settle):
            time.sleep(_LOOK)
        say("counted", clients=[client.told() for client in clients])


if __name__ == "__main__":
    main()
