"""Fuzz target: the beacon parser."""

from __future__ import annotations

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import Guid, Identity
from rmpa.discovery.beacon import Beacon, BeaconKind

_IDENTITY = Identity(Guid.of("10.0.0.1", 40001, 7), bytes(range(16)), "base")

SEEDS: list[bytes] = [
    b"",
    b"RMPA",
    Beacon(BeaconKind.ANNOUNCE, _IDENTITY, 16000, 1).serialize(),
    Beacon(BeaconKind.ANSWER, _IDENTITY, 16000, 2, (Guid.of("10.0.0.2", 40002), Guid.of("10.0.0.3", 1))).serialize(),
    Beacon(
        BeaconKind.HEARTBEAT, _IDENTITY, 16000, 3, (Guid.of("10.0.0.2", 40002),), (("192.168.0.9", 40002),)
    ).serialize(),
    Beacon(BeaconKind.GOODBYE, _IDENTITY, 0, 0xFFFFFFFF).serialize() + b"later versions",
]


def fuzz(data: bytes) -> None:
    """Whatever comes in: a beacon that survives its own round trip, or a documented error."""
    try:
        beacon = Beacon.parse(data, 0)
    except RemoteProtocolError as error:
        str(error)
        return
    wire = beacon.serialize()
    if Beacon.parse(wire, 0) != beacon or not data.startswith(wire):
        raise AssertionError(f"{beacon} does not survive its round trip")
    if not str(beacon).isprintable():
        raise AssertionError("a beacon's text is not safe to log")
