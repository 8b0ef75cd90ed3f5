"""A network that exists only in memory: seeded, so that one seed always gives one and the same run.

Datagrams are lost, doubled, delayed and thereby reordered; ``sockets`` has the byte streams.
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

_KEPT_LINES: Final = 400


class Trace:
    """Chance, and the trace of what happened; the clock is a subclass's.

    Args:
        seed: Everything that happens follows from it.
        keep: Keep the whole trace, not only its last lines.
    """

    now: float

    def __init__(self, seed: int, *, keep: bool = False) -> None:
        self.rng = random.Random(seed)
        self.lines: deque[str] = deque(maxlen=None if keep else _KEPT_LINES)
        self._digest = hashlib.sha256()

    def note(self, who: str, what: str) -> None:
        """Write one line of the trace."""
        line = f"{self.now - 1000:10.6f} {who:>8} {what}"
        self._digest.update(line.encode())
        self.lines.append(line)

    @property
    def trace_hash(self) -> str:
        """Of the whole trace so far."""
        return self._digest.hexdigest()

    def report(self, error: AssertionError, again: str) -> str:
        """What failed, the last events, and the options by which it is played again."""
        lines = "\n".join(list(self.lines)[-60:])
        return (
            f"{error}\n--- the last events ---\n{lines}\n--- all of them, exactly so again ---\n"
            f"python -m tests.simulation {again}\n"
        )


class World(Trace):
    """The simulated clock, the scheduled actions, and the trace; see ``Trace``."""

    def __init__(self, seed: int, *, keep: bool = False) -> None:
        super().__init__(seed, keep=keep)
        self.now = 1000.0
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0

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
    tcp: dict[Address, SimListener] = field(default_factory=dict)
    """Listening sockets by address."""
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

    def kill(self, host: str) -> None:
        """A process dies: its kernel resets its connections."""
        for sock in [sock for sock in self.connections.values() if sock.host == host]:
            sock.kill()
