"""Fuzz target: the parser of the failure detector's packets."""

from __future__ import annotations

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.guid import Guid
from rmpa.discovery.swim.packets import MemberState, News, SwimKind, SwimPacket, is_swim

_GUID = Guid.of("10.0.0.1", 40001, 7)
_RUN = bytes(range(16))
_OTHER = (Guid.of("10.0.0.2", 40002, 1), bytes(range(8, 16)))
_NEWS = (
    News(*_OTHER, MemberState.ALIVE, 0, 3),
    News(*_OTHER, MemberState.SUSPECT, 1, 3, bytes(8)),
    News(*_OTHER, MemberState.FAILED, 1, 3),
)

SEEDS: list[bytes] = [
    b"",
    b"RMPA\x01\x10",
    SwimPacket(SwimKind.PROBE, _GUID, _RUN, 0, 1, subject=_OTHER).serialize(),
    SwimPacket(SwimKind.ACK, _GUID, _RUN, 0, 1, 77, 2, 3, active=True, subject=_OTHER, news=_NEWS).serialize(),
    SwimPacket(SwimKind.NEWS, _GUID, _RUN, 0, 1, news=_NEWS).serialize() + b"later versions",
    SwimPacket(SwimKind.SYNC, _GUID, _RUN, 0, 1, buckets=tuple(range(64))).serialize(),
    SwimPacket(SwimKind.TABLE, _GUID, _RUN, 0, 1, news=_NEWS, wanted=1 << 63).serialize(),
]


def fuzz(data: bytes) -> None:
    """Whatever comes in: a packet that survives its own round trip, or a documented error."""
    try:
        packet = SwimPacket.parse(data, 0)
    except RemoteProtocolError as error:
        str(error)
        return
    wire = packet.serialize()
    if not is_swim(wire) or SwimPacket.parse(wire, 0) != packet:
        raise AssertionError(f"{packet} does not survive its round trip")
    if not str(packet).isprintable():
        raise AssertionError("a packet's text is not safe to log")
