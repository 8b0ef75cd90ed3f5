"""Peers, and connection machines in pairs, for the tests of this room."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rmpa.core.identity import Guid, Identity
from rmpa.core.outbox import ABORT, FIRST, LAST
from rmpa.mesh.connection import ConnectionProtocol, DataHandler
from rmpa.mesh.frames import FrameKind, Hello, Lane, Link, Refuse

LOW = Identity(Guid.of("10.0.0.1", 40001, 1), b"L" * 16, "low")
HIGH = Identity(Guid.of("10.0.0.2", 40002, 1), b"H" * 16, "high")

DIALLER, ACCEPTOR = "dialler", "acceptor"

WALL = 1_700_000_000_000_000_000


class Known(Link):
    """A link whose state a test sets."""

    alive, stuck = True, False


def with_peer(identity: Identity, *, dialled: bool = True, alive: bool = True) -> Known:
    link = Known(identity, identity.guid.endpoint, dialled=dialled)
    link.alive = alive
    return link


class _Route:
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


class Time:
    """A clock that tests move."""

    def __init__(self) -> None:
        self.now = 100.0
        self.offset_ns = 0

    def wall_ns(self) -> int:
        return WALL + round(self.now * 1e9) + self.offset_ns


class Side(ConnectionProtocol):
    """One connection machine, its events as tuples and its data.

    Args:
        role: Which side.
        ours: Its identity.
        time: Its clocks.
        verdict: The acceptor's answer to each hello; ``None`` accepts it.
        options: As of ``ConnectionProtocol``.
    """

    def __init__(
        self, role: str, ours: Identity, time: Time, *, verdict: Refuse | None = None, **options: Any
    ) -> None:
        self.events: list[tuple[Any, ...]] = []
        self.data: list[tuple[int, int, int, bytes]] = []
        self.parts: list[tuple[int, int, int, int, bytes]] = []
        self.verdict = verdict
        super().__init__(ours, time.now, dialled=role == DIALLER, wall_ns=time.wall_ns, **options)
        self.routes = AnyRoute(
            lambda route, seq, stamp, view: self.data.append((route, seq, stamp, bytes(view))),
            lambda route, seq, stamp, flags, view: self.parts.append((route, seq, stamp, flags, bytes(view))),
        )

    def judge(self, hello: Hello) -> Refuse | None:
        if not self.dialled:
            self.events.append(("hello", hello.identity))
        return super().judge(hello) or self.verdict

    def opened(self) -> None:
        assert self.remote is not None
        self.events.append(("opened", self.remote.identity))

    def refused(self, refuse: Refuse, *, by_us: bool) -> None:
        self.events.append(("refused", refuse, by_us))

    def control_received(self, payload: bytes) -> None:
        self.events.append(("control", payload))

    def mark_received(self, kind: FrameKind, route: int, sequence: int) -> None:
        self.events.append(("mark", kind, route, sequence))

    def pong_received(self, stamp: int, rtt: float) -> None:
        self.events.append(("pong", stamp, rtt))

    def closed(self, reason: str) -> None:
        self.events.append(("closed", reason))

    def last(self) -> tuple[Any, ...]:
        return self.events[-1]

    def seen(self, kind: str) -> list[tuple[Any, ...]]:
        """The events of one kind."""
        return [event for event in self.events if event[0] == kind]

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


def pass_time(link: ConnectionProtocol, time: Time, seconds: float) -> None:
    """Let time pass as a driver does: timers are handled when they are due."""
    end = time.now + seconds
    while (due := link.next_timer()) is not None and due <= end:
        time.now = max(time.now, due)
        link.handle_timer(time.now)
    time.now = end


def deliver(data: bytes, target: ConnectionProtocol, now: float, chunk: int = 1 << 30) -> None:
    """Bring bytes as a driver would: what is not consumed is kept and offered again with more."""
    kept = b""
    for start in range(0, len(data), chunk):
        kept += data[start : start + chunk]
        consumed, _ = target.receive(memoryview(kept), now)
        kept = kept[consumed:]


def pair(time: Time, *, lane: Lane = Lane.EXPRESS) -> tuple[Side, Side]:
    """A dialler and an acceptor, both up."""
    dialler = Side(DIALLER, LOW, time, expected=HIGH.guid, lane=lane)
    acceptor = Side(ACCEPTOR, HIGH, time)
    exchange(dialler, acceptor, time)
    assert dialler.up
    assert acceptor.up
    return dialler, acceptor


def exchange(one: Side, other: Side, time: Time, chunk: int = 1 << 30) -> None:
    while one.output or other.output:
        deliver(one.take_output(), other, time.now, chunk)
        deliver(other.take_output(), one, time.now, chunk)
