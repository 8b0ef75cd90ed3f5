"""Heartbeats that were parsed before: of a peer at rest only their number differs, and parsing takes the longest."""

from __future__ import annotations

from typing import Final

from rmpa.core import limits as core_limits
from rmpa.discovery.beacon import KIND_AT, RUN_AT, SEQUENCE_AT, Beacon, BeaconKind

_RUN: Final = slice(*RUN_AT)
_NUMBER: Final = slice(*SEQUENCE_AT)


class ParsedHeartbeats:
    """The last heartbeat of each peer, as bytes and as parsed.

    Args:
        trailer: Bytes behind each packet that are no part of the beacon: the proof of a secured mesh.
    """

    def __init__(self, trailer: int = 0) -> None:
        self._trailer = trailer
        self._last: dict[bytes, tuple[bytes, bytes, Beacon]] = {}

    def __len__(self) -> int:
        return len(self._last)

    def find(self, data: bytes) -> Beacon | None:
        """The beacon in a packet that differs from a kept one in its number alone; ``None``: it must be parsed."""
        found = self._last.get(data[_RUN])
        if found is None or not data.startswith(found[0]) or self._rest(data) != found[1]:
            return None
        return found[2].renumbered(int.from_bytes(data[_NUMBER], "big"))

    def keep(self, data: bytes, beacon: Beacon) -> None:
        """Keep a packet of a peer that is known not to be forged, if it is a heartbeat."""
        if data[KIND_AT] != BeaconKind.HEARTBEAT:
            return
        if len(self._last) >= 2 * core_limits.PEERS_MAX:
            self._last.clear()  # of runs that ended; those that go on are soon here again
        self._last[data[_RUN]] = (data[: _NUMBER.start], self._rest(data), beacon)

    def _rest(self, data: bytes) -> bytes:
        return data[_NUMBER.stop : len(data) - self._trailer]
