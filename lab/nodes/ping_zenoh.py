"""Zenoh between two ends: ``ping_zenoh.py serve|ping PORT [--shared-memory] [--through]``; lines of ``roundtrips``.

Its best settings for latency: a TCP link named on both sides (no scouting, no gossip), express messages (not
batched), the highest data priority, a blocking ``recv`` (a callback that wakes the main thread is slower). Such a
link loses nothing, so there is no time-out. ``--shared-memory`` lets large messages bypass TCP. With ``--through``
both ends are clients of the router at the endpoint that stands in place of the port.
"""

from __future__ import annotations

import json
import sys
import time
from typing import TYPE_CHECKING

import zenoh

from node import say
from roundtrips import measure
from zenoh_router import settings_of

if TYPE_CHECKING:
    from collections.abc import Callable


def config(listen: list[str], connect: list[str], *, shared_memory: bool) -> zenoh.Config:
    made = zenoh.Config()
    settings = {
        "mode": "peer",
        "listen/endpoints": listen,
        "connect/endpoints": connect,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": shared_memory,
    }
    for key, value in settings.items():
        made.insert_json5(key, json.dumps(value))
    return made


def publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    return session.declare_publisher(
        key,
        express=True,
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.REAL_TIME,
        reliability=zenoh.Reliability.RELIABLE,
    )


def serve(settings: zenoh.Config) -> None:
    session = zenoh.open(settings)
    back = publisher(session, "bench/pong")
    asked = session.declare_subscriber("bench/ping")
    say("up")
    while True:
        back.put(asked.recv().payload)


def ping(settings: zenoh.Config) -> None:
    session = zenoh.open(settings)
    there = publisher(session, "bench/ping")
    came = session.declare_subscriber("bench/pong")

    def trips_of(size: int) -> Callable[[], bool]:
        data = bytes(size)

        def trip() -> bool:
            there.put(data)
            return len(came.recv().payload) == size

        return trip

    there.put(bytes(64))
    while came.try_recv() is None:  # both sides must first discover each other's subscriber
        time.sleep(0.1)
        there.put(bytes(64))
    time.sleep(0.2)
    while came.try_recv() is not None:
        pass
    measure(trips_of)
    session.close()


if __name__ == "__main__":
    role, port, *flags = sys.argv[1:]
    run = serve if role == "serve" else ping
    if "--through" in flags:
        run(settings_of("client", {"connect/endpoints": [port]}))
    else:
        at = [f"tcp/127.0.0.1:{port}"]
        shared = "--shared-memory" in flags
        run(config(at, [], shared_memory=shared) if role == "serve" else config([], at, shared_memory=shared))
