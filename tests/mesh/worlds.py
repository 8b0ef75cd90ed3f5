"""Peers, links in pairs and a scheduler that tries every interleaving, for the tests of this room."""

from __future__ import annotations

from dataclasses import dataclass, field

from rmpa.core.guid import Guid
from rmpa.core.identity import Identity
from rmpa.mesh.link import Event, Link, Role

LOW = Identity(Guid.of("10.0.0.1", 40001, 1), b"L" * 16, "low")
HIGH = Identity(Guid.of("10.0.0.2", 40002, 1), b"H" * 16, "high")

WALL = 1_700_000_000_000_000_000


@dataclass
class Side:
    """One link machine and what it said."""

    link: Link
    events: list[Event] = field(default_factory=list)
    data: list[tuple[int, int, int, bytes]] = field(default_factory=list)

    def last(self) -> Event:
        return self.events[-1]


class Time:
    """A clock that tests move."""

    def __init__(self) -> None:
        self.now = 100.0
        self.offset_ns = 0

    def wall_ns(self) -> int:
        return WALL + round(self.now * 1e9) + self.offset_ns


def side(role: Role, ours: Identity, time: Time, *, expected: Guid | None = None, lease: float = 1.0) -> Side:
    events: list[Event] = []
    data: list[tuple[int, int, int, bytes]] = []
    link = Link(
        role,
        ours,
        time.now,
        wall_ns=time.wall_ns,
        on_event=events.append,
        on_data=lambda route, seq, stamp, view: data.append((route, seq, stamp, bytes(view))),
        expected=expected,
        lease=lease,
    )
    return Side(link, events, data)


def deliver(data: bytes, target: Link, now: float, chunk: int = 1 << 30) -> None:
    """Bring bytes as a driver would: what is not consumed is kept and offered again with more."""
    kept = b""
    for start in range(0, len(data), chunk):
        kept += data[start : start + chunk]
        consumed, _ = target.receive(memoryview(kept), now)
        kept = kept[consumed:]
