"""What stands on both sides of the data path: a clock, a link that writes down what it was given, an outlet."""

from __future__ import annotations

import asyncio
import heapq
import itertools
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, Final, cast
from unittest import mock

from rmpa.bridge.data.export import ExportFlow, ExportRoute
from rmpa.bridge.data.route_sender import RouteSender
from rmpa.bridge.messages import Source
from rmpa.bridge.offers import PeerRun
from rmpa.core.contract import Contract
from rmpa.core.outbox import QueuedMessage

WALL: Final = 1_700_000_000_000_000_000
"""The wall clock, in ns, when the other one says 0."""


class Timer:
    """A call that was asked for."""

    def __init__(self, when: float, call: Callable[[], object]) -> None:
        self._when = when
        self.call: Callable[[], object] | None = call

    def when(self) -> float:
        """When."""
        return self._when

    def cancel(self) -> None:
        """It is not wanted any more."""
        self.call = None


class Clock:
    """As much of an event loop as the data path asks for; time goes on when told to."""

    def __init__(self, now: float = 1000.0) -> None:
        self.now = now
        self._timers: list[tuple[float, int, Timer]] = []
        self._numbers = itertools.count()

    def time(self) -> float:
        """Monotonic seconds."""
        return self.now

    def wall_ns(self) -> int:
        """The wall clock: as many seconds behind ``WALL``."""
        return WALL + round(self.now * 1e9)

    def call_at(self, when: float, call: Callable[..., object], *arguments: object) -> Timer:
        """As an event loop's."""
        timer = Timer(when, lambda: call(*arguments))
        heapq.heappush(self._timers, (when, next(self._numbers), timer))
        return timer

    def call_later(self, delay: float, call: Callable[..., object], *arguments: object) -> Timer:
        """As an event loop's."""
        return self.call_at(self.now + delay, call, *arguments)

    @property
    def due(self) -> list[float]:
        """When something is to be called."""
        return sorted(when for when, _, timer in self._timers if timer.call is not None)

    def advance(self, seconds: float) -> None:
        """Let time go on; what is due in between is called at its time."""
        until = self.now + seconds
        while self._timers and self._timers[0][0] <= until:
            when, _, timer = heapq.heappop(self._timers)
            self.now = max(self.now, when)
            if timer.call is not None:
                timer.call()
        self.now = until


@contextmanager
def running(clock: Clock) -> Iterator[Clock]:
    """Let a clock be the running event loop, and the wall clock of the flows."""
    asyncio._set_running_loop(cast("asyncio.AbstractEventLoop", clock))
    try:
        wall = SimpleNamespace(time_ns=clock.wall_ns)
        with (
            mock.patch("rmpa.bridge.data.export.time", wall),
            mock.patch("rmpa.bridge.data.reception.time", wall),
        ):
            yield clock
    finally:
        asyncio._set_running_loop(None)


def add(flow: ExportFlow, peer: int, link: Link, number: int, contract: Contract) -> RouteSender:
    """Begin to send to a peer."""
    remove(flow, peer)
    route = flow.routes[peer] = ExportRoute(PeerRun(peer=peer), Source("/t", "/n"), number, contract)
    return flow.add(route, link)


def remove(flow: ExportFlow, peer: int) -> None:
    """Send to a peer no more."""
    if (route := flow.routes.pop(peer, None)) is not None:
        flow.remove(route)


class Lane:
    """One lane of a link; writes down what it is given.

    Args:
        link: Its own.
        name: ``express`` or ``bulk``.
    """

    def __init__(self, link: Link, name: str) -> None:
        self.link = link
        self.name = name
        self.terms: dict[int, tuple[int, float | None, int, bool]] = {}
        self._parts: dict[int, bytearray] = {}

    def send(self, route: int, sequence: int, stamp_ns: int, payload: bytes | bytearray | memoryview) -> int:
        """Take a message."""
        self.link.took(self.name, route, sequence, stamp_ns, bytes(payload))
        return self.link.drops.popleft() if self.link.drops else 0

    def open(self, route: int, size: int, sequence: int, stamp_ns: int) -> QueuedMessage:
        """Begin a message."""
        parcel = QueuedMessage(route, size, sequence, stamp_ns)
        self._parts[id(parcel)] = bytearray()
        self.link.log.append((self.name, "open", route, sequence, size))
        self.link.parcels.append(parcel)
        return parcel

    def extend(self, parcel: QueuedMessage, data: bytes | bytearray | memoryview) -> int:
        """Take more of it."""
        whole = self._parts[id(parcel)]
        whole += data
        parcel.sent += len(data)
        assert parcel.sent <= parcel.size
        if parcel.sent == parcel.size:
            self.link.took(self.name, parcel.key, parcel.sequence, parcel.stamp_ns, bytes(whole))
        return self.link.drops.popleft() if self.link.drops else 0

    def abandon(self, parcel: QueuedMessage) -> None:
        """It ends in the middle."""
        self.link.log.append((self.name, "abandon", parcel.key, parcel.sequence))

    def fence(self, route: int, number: int) -> None:
        """Take a fence."""
        self.link.log.append((self.name, "fence", route, number))
        self.link.fences.append((self.name, number))

    def set_terms(
        self, route: int, depth: int, max_age: float | None = None, *, above: int = 0, spared: bool = False
    ) -> None:
        """Take a route's bounds."""
        self.terms[route] = (depth, max_age, above, spared)

    def discard(self, route: int) -> None:
        """Let go of what waits of a route, and of its bounds."""
        self.terms.pop(route, None)
        self.link.log.append((self.name, "discard", route))


class Link(Any):  # type: ignore[misc] # a double of what is much larger
    """Both lanes of a link."""

    def __init__(self) -> None:
        self.log: list[tuple[object, ...]] = []
        """All that it was given, in order."""
        self.sent: list[tuple[str, int, bytes]] = []
        """Whole messages: lane, sequence, payload."""
        self.stamps: list[int] = []
        self.routes: list[int] = []
        self.fences: deque[tuple[str, int]] = deque()
        """Not answered: lane, number."""
        self.drops: deque[int] = deque()
        """What the next calls return."""
        self.parcels: list[QueuedMessage] = []
        self.express = Lane(self, "express")
        self.bulk = Lane(self, "bulk")

    def took(self, lane: str, route: int, sequence: int, stamp_ns: int, payload: bytes) -> None:
        """A whole message is there."""
        self.log.append((lane, "message", route, sequence))
        self.sent.append((lane, sequence, payload))
        self.stamps.append(stamp_ns)
        self.routes.append(route)

    @property
    def numbers(self) -> list[int]:
        """The sequences of all messages."""
        return [sequence for _, sequence, _ in self.sent]

    @property
    def lanes(self) -> list[str]:
        """Their lanes."""
        return [lane for lane, _, _ in self.sent]


class Outlet:
    """Local subscribers behind a proxy: one that is always there, and must never get a mixture."""

    def __init__(self) -> None:
        self.got: list[bytes] = []
        self.parts = 0
        self.torn = 0
        """How often it was hung up on."""
        self._half: bytearray | None = None
        self._size = 0

    @property
    def in_the_middle(self) -> bool:
        """Whether it has half a message."""
        return self._half is not None

    def publish_framed(self, framed: bytes | bytearray | memoryview) -> object:
        """Take a message."""
        assert self._half is None, "a message in the middle of another one"
        self.take(bytes(framed))
        return None

    def take(self, message: bytes) -> None:
        """A whole message is there."""
        self.got.append(message)

    def begin(self, size: int) -> None:
        """Take the beginning of one."""
        assert self._half is None, "a message in the middle of another one"
        self._half, self._size = bytearray(), size

    def extend(self, part: bytes | bytearray | memoryview) -> None:
        """Take more of it."""
        assert self._half is not None
        self._half += part
        self.parts += 1
        assert len(self._half) <= self._size
        if len(self._half) == self._size:
            whole, self._half = bytes(self._half), None
            self.take(whole)

    def abort(self) -> int:
        """It ends in the middle; whoever has a part of it is hung up on."""
        half, self._half = self._half, None
        self.torn += bool(half)
        return int(bool(half))
