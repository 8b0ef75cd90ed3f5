"""A network that exists only in memory: seeded, so that one seed always gives one and the same run.

Datagrams are lost, doubled, delayed and thereby reordered; byte streams keep their order, are cut into other
pieces than they were sent in, stall while the network is parted, and break when an end dies.
"""

from __future__ import annotations

import hashlib
import heapq
import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from tests.simulation.sockets import SimListener, SimSocket

Address = tuple[str, int]
OnDatagram = Callable[[bytes, Address, bool], None]
OnAccept = Callable[["End"], None]
OnDialled = Callable[["End | None"], None]

_RETRY: Final = 0.2
"""Seconds between two attempts of a stalled stream to go on, like TCP's retransmissions."""
_KEPT_LINES: Final = 400


class World:
    """The simulated clock, the scheduled actions, and the trace of what happened.

    Args:
        seed: Everything that happens follows from it.
        keep: Keep the whole trace, not only its last lines.
    """

    def __init__(self, seed: int, *, keep: bool = False) -> None:
        self.rng = random.Random(seed)
        self.now = 1000.0
        self.lines: deque[str] = deque(maxlen=None if keep else _KEPT_LINES)
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0
        self._digest = hashlib.sha256()

    def at(self, when: float, action: Callable[[], None]) -> None:
        """Schedule ``action`` at ``when``; actions of one moment run in the order of these calls."""
        self._count += 1
        heapq.heappush(self._queue, (max(when, self.now), self._count, action))

    def after(self, delay: float, action: Callable[[], None]) -> None:
        """Schedule ``action`` in ``delay`` seconds."""
        self.at(self.now + delay, action)

    def time_ns(self) -> int:
        """The wall clock of every host."""
        return round(self.now * 1e9)

    def run(self, until: float) -> None:
        """Run all actions up to ``until``."""
        while self._queue and self._queue[0][0] <= until:
            self.now, _, action = heapq.heappop(self._queue)
            action()
        self.now = until

    def note(self, who: str, what: str) -> None:
        """Write one line of the trace."""
        line = f"{self.now - 1000:10.6f} {who:>8} {what}"
        self._digest.update(line.encode())
        self.lines.append(line)

    @property
    def trace_hash(self) -> str:
        """Of the whole trace so far."""
        return self._digest.hexdigest()


@dataclass
class Weather:
    """How bad the network is now."""

    loss: float = 0.0
    double: float = 0.0
    delay: tuple[float, float] = (0.0002, 0.002)


@dataclass
class Network:
    """Hosts, which of them reach each other, and what is in flight between them.

    Args:
        world: Clock and chance.
        weather: May be changed at any time.
    """

    world: World
    weather: Weather = field(default_factory=Weather)
    segments: dict[str, int] = field(default_factory=dict)
    """Host to multicast domain, within which multicasts travel. A missing host has none."""
    sides: dict[str, int] = field(default_factory=dict)
    """Host to side of a partition; empty while the network is whole."""
    sockets: dict[Address, OnDatagram] = field(default_factory=dict)
    listeners: dict[Address, OnAccept] = field(default_factory=dict)
    streams: list[Stream] = field(default_factory=list)
    tcp: dict[Address, SimListener] = field(default_factory=dict)
    """Listening sockets by address; ``listeners`` and ``streams`` are a simpler kind, without sockets."""
    connections: dict[int, SimSocket] = field(default_factory=dict)
    """Every open end of a connection, by its descriptor."""
    walled: set[str] = field(default_factory=set)
    """Hosts behind a firewall: they can dial but not be dialled."""
    slowness: tuple[float, ...] = (1.0, 1.0, 3.0)
    """A connection takes the delay times one of these, by chance."""
    datagrams: int = 0

    def reaches(self, host: str, other: str) -> bool:
        """Whether packets get from one host to the other now."""
        return self.sides.get(host, 0) == self.sides.get(other, 0)

    def delay(self) -> float:
        """Deliver one packet, or lose, repeat or delay it."""
        return self.world.rng.uniform(*self.weather.delay)

    def unicast(self, source: Address, to: Address, data: bytes) -> None:
        """Send one datagram."""
        self._travel(source, to, data, multicast=False)

    def multicast(self, source: Address, data: bytes) -> None:
        """Send one datagram to all others of the sender's segment, and back to itself."""
        segment = self.segments.get(source[0])
        if segment is None:
            return
        for to in sorted(self.sockets):
            if self.segments.get(to[0]) == segment:
                self._travel(source, to, data, multicast=True)

    def _travel(self, source: Address, to: Address, data: bytes, *, multicast: bool) -> None:
        rng = self.world.rng
        copies = 2 if rng.random() < self.weather.double else 1
        for _ in range(copies):
            if self.reaches(source[0], to[0]) and rng.random() >= self.weather.loss:
                self.world.after(self.delay(), lambda: self._arrive(source, to, data, multicast=multicast))

    def _arrive(self, source: Address, to: Address, data: bytes, *, multicast: bool) -> None:
        receive = self.sockets.get(to)
        if receive is not None and self.reaches(source[0], to[0]):
            self.datagrams += 1
            receive(data, source, multicast)

    def dial(self, host: str, to: Address, on_done: OnDialled) -> None:
        """Connect a byte stream; ``on_done(None)`` if no process listens there, no call while hosts are parted."""

        def arrive() -> None:
            if to[0] in self.walled or not self.reaches(host, to[0]):
                return
            accept = self.listeners.get(to)
            if accept is None:
                self.world.after(self.delay(), lambda: on_done(None))
                return
            stream = Stream(self, host, to[0])
            self.streams.append(stream)
            accept(stream.callee)
            self.world.after(self.delay(), lambda: on_done(stream.caller))

        self.world.after(self.delay(), arrive)

    def kill(self, host: str) -> None:
        """A process dies: its kernel resets its streams."""
        for stream in [s for s in self.streams if host in {s.caller.host, s.callee.host}]:
            for end in (stream.caller, stream.callee):
                if end.host == host:
                    end.close(reset=True)
        for sock in [sock for sock in self.connections.values() if sock.host == host]:
            sock.kill()


class Stream:
    """A connected pair of ends."""

    def __init__(self, network: Network, caller: str, callee: str) -> None:
        self.caller = End(network, self, caller)
        self.callee = End(network, self, callee)
        self.caller.other, self.callee.other = self.callee, self.caller


class End:
    """One end of a byte stream.

    Set ``on_bytes`` and ``on_close`` (called with whether it was a reset) before anything arrives.
    """

    other: End

    def __init__(self, network: Network, stream: Stream, host: str) -> None:
        self.host = host
        self.closed = False
        self.on_bytes: Callable[[bytes], None] = lambda _: None
        self.on_close: Callable[[bool], None] = lambda _: None
        self._network = network
        self._stream = stream
        self._packets: deque[tuple[float, bytes | bool]] = deque()
        self._pumping = False
        self._early: list[bytes | bool] = []
        self.ready = False

    def send(self, data: bytes) -> None:
        """Send bytes; they arrive in order, in other pieces."""
        rng = self._network.world.rng
        while data and not self.closed:
            size = len(data) if rng.random() < 0.7 else rng.randint(1, len(data))
            self._push(data[:size])
            data = data[size:]

    def close(self, *, reset: bool = False) -> None:
        """Close this end; the other one notices after the bytes in flight (if reset: at once, and they are lost)."""
        if self.closed:
            return
        self.closed = True
        if reset:
            self._packets.clear()
        self._push(reset)

    def begin(self) -> None:
        """The callbacks are set: deliver what came meanwhile."""
        self.ready = True
        early, self._early = self._early, []
        for item in early:
            self.arrive(item)

    def arrive(self, item: bytes | bool) -> None:
        """Deliver one piece, or the end."""
        if self.closed:
            return
        if not self.ready:
            self._early.append(item)
        elif isinstance(item, bytes):
            self.on_bytes(item)
        else:
            self.closed = True
            self._forget()
            self.on_close(item)

    def _push(self, item: bytes | bool) -> None:
        when = self._network.world.now + self._network.delay()
        if self._packets:
            when = max(when, self._packets[-1][0])
        self._packets.append((when, item))
        if not self._pumping:
            self._pumping = True
            self._network.world.at(when, self._pump)

    def _pump(self) -> None:
        world = self._network.world
        while self._packets and self._packets[0][0] <= world.now:
            if self.other.closed:
                self._packets.clear()
                break
            if not self._network.reaches(self.host, self.other.host):
                world.after(_RETRY, self._pump)
                return
            _, item = self._packets.popleft()
            self.other.arrive(item)
        self._pumping = bool(self._packets)
        if self._pumping:
            world.at(self._packets[0][0], self._pump)
        else:
            self._forget()

    def _forget(self) -> None:
        if self.closed and self.other.closed and self._stream in self._network.streams:
            self._network.streams.remove(self._stream)
