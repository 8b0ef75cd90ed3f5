"""ZeroMQ, a PAIR of sockets over TCP: ``ping_zmq.py serve | ping PORT``; lines of ``roundtrips``.

Its best settings: blocking calls (a poll before each costs a system call more); large messages are not copied.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import zmq

from node import say
from roundtrips import TIMEOUT, measure

if TYPE_CHECKING:
    from collections.abc import Callable

_NO_COPY_FROM = 32 * 1024
"""Below, keeping a reference costs more than the copy."""


def serve() -> None:
    pair = zmq.Context().socket(zmq.PAIR)
    say("up", port=pair.bind_to_random_port("tcp://127.0.0.1"))
    while True:
        pair.send(pair.recv(copy=False), copy=False)


def ping(port: int) -> None:
    pair = zmq.Context().socket(zmq.PAIR)
    pair.setsockopt(zmq.RCVTIMEO, int(1000 * TIMEOUT))
    pair.setsockopt(zmq.LINGER, 0)
    pair.connect(f"tcp://127.0.0.1:{port}")

    def trips_of(size: int) -> Callable[[], bool]:
        data = bytes(size)
        copy = size < _NO_COPY_FROM

        def trip() -> bool:
            try:
                pair.send(data, copy=copy)
                return len(pair.recv(copy=copy)) == size
            except zmq.Again:
                return False

        return trip

    measure(trips_of)


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve()
    else:
        ping(int(sys.argv[2]))
