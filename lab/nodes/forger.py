"""Attack an agent's mesh port without being a member, at a steady rate.

``beacons``: packets as members send them, with a tag that is not the group key's; ``prefaces``: connections that
begin with such a preface; ``handshakes``: connections that say nothing. Arguments: kind, host, port, --rate. Events:
up; sent with the count, twice a second. Ends by a signal.
"""

from __future__ import annotations

import argparse
import os
import socket
import struct
import time
from contextlib import suppress
from typing import Final

from node import say
from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.discovery.beacon import Beacon, BeaconKind
from rmpa.trust.keyring import GroupKey, KeyPurpose, KeyRing
from rmpa.trust.packets import PacketSigner
from rmpa.trust.preface import Preface, Purpose

_RESET: Final = struct.pack("ii", 1, 0)
_HELD: Final = 256
"""Connections that are open at a time."""
_KEY: Final = GroupKey(1, b"guessed" + bytes(25))
_BATCH: Final = 10


def beacon(number: int, host: str) -> bytes:
    """A forged beacon of a run that is new."""
    identity = Identity(Guid.of(host, 40000, number % 65536), os.urandom(16), "forged")
    packet = Beacon(BeaconKind.HEARTBEAT, identity, 10_000, number).serialize(extended=True)
    return PacketSigner(KeyRing([_KEY], 0.0)).sign(packet, KeyPurpose.BEACON, 1.0, time.time())


def preface() -> bytes:
    """A forged preface, and the begin of a TLS handshake."""
    made = Preface(Purpose.LINK, _KEY.short, int(time.time() * 1000), os.urandom(16))
    return made.serialize(_KEY.key_for(KeyPurpose.PREFACE)) + b"\x16\x03\x01\x02\x00" + bytes(512)


def _connect(address: tuple[str, int], data: bytes, held: list[socket.socket]) -> None:
    """Begin ``_BATCH`` connections, then send on each; the oldest that are open are reset."""
    new = [socket.socket() for _ in range(_BATCH)]
    for sock in new:
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)  # so that no port waits for late packets
        with suppress(OSError):
            sock.connect(address)
    if data:
        for sock in new:
            with suppress(OSError):  # the agent's queue is full
                sock.send(data)
    held += new
    for old in held[:-_HELD]:
        old.close()
    del held[:-_HELD]


def main() -> None:
    """Attack until a signal comes."""
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=("beacons", "prefaces", "handshakes"))
    parser.add_argument("host")
    parser.add_argument("port", type=int)
    parser.add_argument("--rate", type=float, default=10_000.0)
    options = parser.parse_args()
    address = (options.host, options.port)
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    packets = [beacon(number, "10.9.9.9") for number in range(1000)]
    greeting = preface() if options.kind == "prefaces" else b""
    held: list[socket.socket] = []
    say("up")
    sent, begun, told = 0, time.monotonic(), 0.0
    while True:
        now = time.monotonic() - begun
        while sent < now * options.rate:
            if options.kind == "beacons":
                for number in range(_BATCH):
                    with suppress(OSError):
                        udp.sendto(packets[(sent + number) % len(packets)], address)
            else:
                _connect(address, greeting, held)
            sent += _BATCH
            if time.monotonic() - begun - now > 0.5:
                break
        if now - told > 0.5:
            told = now
            say("sent", count=sent, seconds=round(now, 3))
        time.sleep(0.0005)


if __name__ == "__main__":
    main()
