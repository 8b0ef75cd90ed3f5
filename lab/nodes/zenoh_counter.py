"""Count what comes of a key, as a client of a router: ``zenoh_counter.py ENDPOINT KEY [HEADER]``.

With ``HEADER``, the key of a topic's header at a gateway, it asks for batches as a gateway does, and counts their
messages.

Events, as of ``counter``: ``up``; ``window`` each 0.5 s: messages and bytes so far, nanoseconds of the steady clock.
"""

from __future__ import annotations

import sys
import time

import zenoh

from node import say
from zenoh_router import settings_of


def main() -> None:
    endpoint, key, *header = sys.argv[1:]
    count = size = 0

    def take(sample: zenoh.Sample) -> None:
        nonlocal count, size
        count += 1
        size += len(sample.payload)

    def take_batch(sample: zenoh.Sample) -> None:
        nonlocal count, size
        payload = sample.payload.to_bytes()
        at = 0
        while at < len(payload):
            at += 4 + int.from_bytes(payload[at : at + 4], "little")
            count += 1
        size += len(payload)

    session = zenoh.open(settings_of("client", {"connect/endpoints": [endpoint]}))
    session.declare_subscriber(f"{key}/@batch" if header else key, take_batch if header else take)
    say("up")
    while header and not any(reply.ok for reply in session.get(f"{header[0]}?site=reader;batches")):
        time.sleep(0.1)
    while True:
        time.sleep(0.5)
        say("window", count=count, bytes=size, ns=time.monotonic_ns())


if __name__ == "__main__":
    main()
