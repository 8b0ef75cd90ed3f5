"""The data path through the bridge: what happens to each message, and nothing else.

Both flows are called from a socket's read callback with a view of its buffer and hand it on with one system call
for each receiver. They take routes as commands and share no state with the planning side.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol

from rmpa.bridge.quality import Quality

if TYPE_CHECKING:
    from rmpa.core.aio.stream import Buffer

_SEQUENCE_MASK: Final = (1 << 32) - 1


class DataLink(Protocol):
    """What the data path needs of a link."""

    def send_data(self, route: int, sequence: int, stamp_ns: int, payload: Buffer) -> int:
        """Send one message; return how many older ones were dropped for it."""
        ...


class Outlet(Protocol):
    """What the data path needs of a publication: local subscribers behind it."""

    def publish_framed(self, framed: Buffer) -> object:
        """Send one message, with its length in front, to each subscriber."""
        ...


@dataclass(slots=True)
class _Leg:
    link: DataLink
    route: int
    sequence: int = 0


class ExportFlow:
    """From one local publisher to the peers that want it."""

    __slots__ = ("_latched", "_legs", "bytes", "dropped", "latching", "messages")

    def __init__(self) -> None:
        self._legs: list[_Leg] = []
        self._latched: tuple[bytes, int] | None = None
        self.latching = False
        self.messages = 0
        self.bytes = 0
        self.dropped = 0

    def add(self, link: DataLink, route: int) -> None:
        """Send to one more peer from now on; first the latched message, if there is one."""
        leg = _Leg(link, route)
        if self._latched is not None:
            framed, stamp = self._latched
            leg.sequence = 1
            link.send_data(route, 1, stamp, framed)
        self._legs = [*self._legs, leg]

    def remove(self, link: DataLink, route: int) -> None:
        """Send to that peer no longer."""
        self._legs = [leg for leg in self._legs if leg.link is not link or leg.route != route]

    def message(self, framed: memoryview) -> None:
        """Hand one message on; ``framed`` has its length in front and is valid during the call only."""
        stamp = time.time_ns()
        self.messages += 1
        self.bytes += len(framed)
        for leg in self._legs:
            leg.sequence = leg.sequence + 1 & _SEQUENCE_MASK
            self.dropped += leg.link.send_data(leg.route, leg.sequence, stamp, framed)
        if self.latching:
            self._latched = (bytes(framed), stamp)


class ImportFlow:
    """From one peer's route to the local subscribers of its proxy."""

    __slots__ = ("_expected", "_outlet", "bytes", "last_stamp_ns", "last_wall_ns", "lost", "messages", "quality")

    def __init__(self, outlet: Outlet) -> None:
        self._outlet = outlet
        self._expected = 1
        self.messages = 0
        self.bytes = 0
        self.lost = 0
        self.last_stamp_ns = 0
        self.last_wall_ns = 0
        self.quality = Quality()

    def message(self, sequence: int, stamp_ns: int, framed: memoryview) -> None:
        """Hand one message on; a gap in the sequence is what the sender's queue dropped."""
        self._outlet.publish_framed(framed)
        if sequence != self._expected:
            self.lost += sequence - self._expected & _SEQUENCE_MASK
        self._expected = sequence + 1 & _SEQUENCE_MASK
        self.messages += 1
        self.bytes += len(framed)
        self.last_stamp_ns = stamp_ns
        self.last_wall_ns = time.time_ns()
        self.quality.arrived(time.monotonic(), self.last_wall_ns, stamp_ns, len(framed))
