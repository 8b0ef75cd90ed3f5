"""Count what comes of a key, as a client of a router: ``zenoh_counter.py ENDPOINT KEY``.

Events, as of ``counter``: ``up``; ``window`` each 0.5 s: messages and bytes so far, nanoseconds of the steady clock.
"""

from __future__ import annotations

import sys
import time

import zenoh

from node import say
from zenoh_router import settings_of


def main() -> None:
    endpoint, key = sys.argv[1:]
    count = size = 0

    def take(sample: zenoh.Sample) -> None:
        nonlocal count, size
        count += 1
        size += len(sample.payload)

    session = zenoh.open(settings_of("client", {"connect/endpoints": [endpoint]}))
    session.declare_subscriber(key, take)
    say("up")
    while True:
        time.sleep(0.5)
        say("window", count=count, bytes=size, ns=time.monotonic_ns())


if __name__ == "__main__":
    main()
