"""Peers, and connection machines in pairs, for the tests of this room."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rmpa.core.identity import Guid, Identity
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.mesh.connection import ConnectionProtocol, ConnectionRole, ConnectionState, DataHandler
from rmpa.mesh.frames import Lane

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.mesh.keepalive import ConnectionEvent, RestPace

LOW = Identity(Guid.of("10.0.0.1", 40001, 1), b"L" * 16, "low")
HIGH = Identity(Guid.of("10.0.0.2", 40002, 1), b"H" * 16, "high")

WALL = 1_700_000_000_000_000_000


class _Route(DataHandler):
    """One route of ``AnyRoute``."""

    def __init__(self, route: int, owner: AnyRoute) -> None:
        self.route, self.owner = route, owner

    def message(self, sequence: int, stamp_ns: int, framed: memoryview) -> None:
        self.owner.data(self.route, sequence, stamp_ns, framed)

    def part(self, sequence: int, stamp_ns: int, flags: int, part: memoryview) -> None:
        self.owner.part(self.route, sequence, stamp_ns, flags, part)


class AnyRoute(dict[int, DataHandler]):
    """All routes are open, and their data goes to two functions, with the route in front."""

    def __init__(
        self,
        data: Callable[[int, int, int, memoryview], object],
        part: Callable[[int, int, int, int, memoryview], object] = lambda *_: None,
    ) -> None:
        super().__init__()
        self.data, self.part = data, part

    def get(self, route: int, _default: object = None) -> DataHandler:
        return _Route(route, self)


@dataclass
class Side:
    """One connection machine, its events and its data."""

    link: ConnectionProtocol
    events: list[ConnectionEvent] = field(default_factory=list)
    data: list[tuple[int, int, int, bytes]] = field(default_factory=list)
    parts: list[tuple[int, int, int, int, bytes]] = field(default_factory=list)

    def last(self) -> ConnectionEvent:
        return self.events[-1]

    def messages(self) -> list[tuple[int, int, int, bytes]]:
        """What came in parts, put together; every part must have its place."""
        whole: list[tuple[int, int, int, bytes]] = []
        begun: dict[int, tuple[int, int, bytes]] = {}
        for route, sequence, stamp, flags, part in self.parts:
            if flags & FIRST:
                assert route not in begun
                begun[route] = (sequence, stamp, b"")
            assert begun[route][:2] == (sequence, stamp)
            begun[route] = (sequence, stamp, begun[route][2] + part)
            if flags & LAST:
                message = (route, *begun.pop(route))
                if not flags & ABORT:
                    whole.append(message)
        assert not begun
        return whole


class Time:
    """A clock that tests move."""

    def __init__(self) -> None:
        self.now = 100.0
        self.offset_ns = 0

    def wall_ns(self) -> int:
        return WALL + round(self.now * 1e9) + self.offset_ns


def pass_time(link: ConnectionProtocol, time: Time, seconds: float) -> None:
    """Let time pass as a driver does: timers are handled when they are due."""
    end = time.now + seconds
    while (due := link.next_timer()) is not None and due <= end:
        time.now = max(time.now, due)
        link.handle_timer(time.now)
    time.now = end


def side(
    role: ConnectionRole,
    ours: Identity,
    time: Time,
    *,
    expected: Guid | None = None,
    lease: float = 1.0,
    lane: Lane = Lane.EXPRESS,
    rest: RestPace | None = None,
) -> Side:
    events: list[ConnectionEvent] = []
    data: list[tuple[int, int, int, bytes]] = []
    parts: list[tuple[int, int, int, int, bytes]] = []
    link = ConnectionProtocol(
        role,
        ours,
        time.now,
        wall_ns=time.wall_ns,
        on_event=events.append,
        expected=expected,
        lane=lane,
        lease=lease,
        rest=rest,
    )
    link.routes = AnyRoute(
        lambda route, seq, stamp, view: data.append((route, seq, stamp, bytes(view))),
        lambda route, seq, stamp, flags, view: parts.append((route, seq, stamp, flags, bytes(view))),
    )
    return Side(link, events, data, parts)


def deliver(data: bytes, target: ConnectionProtocol, now: float, chunk: int = 1 << 30) -> None:
    """Bring bytes as a driver would: what is not consumed is kept and offered again with more."""
    kept = b""
    for start in range(0, len(data), chunk):
        kept += data[start : start + chunk]
        consumed, _ = target.receive(memoryview(kept), now)
        kept = kept[consumed:]


def pair(time: Time, *, lease: float = 1.0, lane: Lane = Lane.EXPRESS) -> tuple[Side, Side]:
    """A dialler and an acceptor, both up."""
    dialler = side(ConnectionRole.DIALLER, LOW, time, expected=HIGH.guid, lease=lease, lane=lane)
    acceptor = side(ConnectionRole.ACCEPTOR, HIGH, time, lease=lease)
    deliver(dialler.link.take_output(), acceptor.link, time.now)
    acceptor.link.accept(time.now)
    exchange(dialler, acceptor, time)
    assert dialler.link.state is ConnectionState.UP
    assert acceptor.link.state is ConnectionState.UP
    return dialler, acceptor


def exchange(one: Side, other: Side, time: Time, chunk: int = 1 << 30) -> None:
    while one.link.has_output or other.link.has_output:
        deliver(one.link.take_output(), other.link, time.now, chunk)
        deliver(other.link.take_output(), one.link, time.now, chunk)
