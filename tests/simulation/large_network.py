"""The network of a large mesh: datagrams and links of hundreds of modules, counted; no sockets.

A multicast is one action for all its receivers, so that 256 modules that each send one are 256 actions and
not 65,000. A link is a pair of machines' views of one connection: its handshake is judged by the real code,
and what crosses it is counted by its size.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from tests.simulation.network import World

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.discovery.beacon import Address, Beacon
    from tests.simulation.large_module import Module

UDP_HEADERS: Final = 28
"""Bytes of IPv4 and UDP around a datagram."""
TCP_BYTES: Final = 10 * 52
"""Bytes of the packets without payload of one connection that begins and ends: handshake, acknowledgements, end."""


@dataclass(slots=True)
class Traffic:
    """What one kind of packet took, in all: a multicast counts once where it is sent, and once at each receiver."""

    sent: int = 0
    sent_bytes: int = 0
    received: int = 0
    received_bytes: int = 0


@dataclass(slots=True, eq=False)
class Link:
    """A connection between two modules; ``ids`` are the numbers that they know it by."""

    ends: tuple[Module, Module]
    ids: tuple[int, int] = (0, 0)
    runs: tuple[int, int] = (0, 0)
    used: bool = False
    up: bool = True

    def other(self, module: Module) -> Module:
        """The module at the other end."""
        return self.ends[1] if self.ends[0] is module else self.ends[0]


@dataclass
class LargeNetwork:
    """What is in flight between the modules.

    Args:
        seed: Everything that happens follows from it.
        loss: Share of datagrams that are lost.
        delay: Seconds of a packet's way, at least and at most.
    """

    seed: int
    loss: float = 0.01
    delay: tuple[float, float] = (0.0002, 0.003)
    modules: dict[Address, Module] = field(default_factory=dict)
    sides: dict[str, int] = field(default_factory=dict)
    """Host to side of a partition; empty while the network is whole."""
    traffic: dict[str, Traffic] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.world = World(self.seed)
        self._hosts: list[Module] | None = None

    @property
    def now(self) -> float:
        """Monotonic seconds, of every module."""
        return self.world.now

    def count(self, kind: str, size: int, receivers: int) -> None:
        """Count one packet that was sent, and how many receive it."""
        row = self.traffic.setdefault(kind, Traffic())
        row.sent += 1
        row.sent_bytes += size
        row.received += receivers
        row.received_bytes += size * receivers

    def join(self, module: Module) -> None:
        """A module's process listens."""
        self.modules[module.address] = module
        self._hosts = None

    def leave(self, module: Module) -> None:
        """A module's process is gone, and its host with it: nothing answers there."""
        self.modules.pop(module.address, None)
        self._hosts = None

    def reaches(self, host: str, other: str) -> bool:
        """Whether packets get from one host to the other now."""
        return not self.sides or self.sides.get(host, 0) == self.sides.get(other, 0)

    def later(self, action: Callable[[], None], times: float = 1.0) -> None:
        """Do something after the way of a packet, or of several one after the other."""
        self.world.after(times * self.world.rng.uniform(*self.delay), action)

    def multicast(self, source: Module, beacon: Beacon, size: int) -> None:
        """Send a beacon to all others, and back to the sender."""

        def arrive() -> None:
            receivers = self._receivers(source)
            self.count("beacon", size + UDP_HEADERS, len(receivers))
            for module in receivers:
                module.hear_beacon(beacon, source.address, multicast=True)

        self.later(arrive)

    def _receivers(self, source: Module) -> list[Module]:
        if self._hosts is None:
            self._hosts = [self.modules[address] for address in sorted(self.modules)]
        chance, loss, host = self.world.rng.random, self.loss, source.address[0]
        return [m for m in self._hosts if chance() >= loss and (not self.sides or self.reaches(host, m.address[0]))]

    def unicast(self, source: Module, to: Address, beacon: Beacon, size: int) -> None:
        """Send one datagram."""
        if self.world.rng.random() < self.loss:
            self.count("beacon", size + UDP_HEADERS, 0)
            return

        def arrive() -> None:
            module = self.modules.get(to)
            there = module is not None and self.reaches(source.address[0], to[0])
            self.count("beacon", size + UDP_HEADERS, int(there))
            if module is not None and there:
                module.hear_beacon(beacon, source.address, multicast=False)

        self.later(arrive)
