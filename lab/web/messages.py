"""Large messages to several clients: processor time of the server, and what a client costs that stops reading."""

from __future__ import annotations

import statistics
import threading
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import psutil

from lab.bed.processes import BedError, Process
from lab.usage import Meter, Usage

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from lab.web.servers import WebServer
    from lab.web.subscriptions import How

# Seconds without a message after which a round is over.
_SETTLE: Final = 0.5
# Messages before a turn, until each client has had one.
_WARM_UP: Final = 5
_WARM_TURNS: Final = 20
# The same beside a client that does not read.
_STALLED_TURNS: Final = 3
# Seconds behind the last message in which the slowest server has sent what it sends.
_WITHIN: Final = 60.0
# Seconds between looks at a server's memory.
_SAMPLE: Final = 0.02


@dataclass(frozen=True, slots=True)
class Load:
    """What is published.

    Args:
        size: Bytes of a message's data.
        rate: Hz.
        count: Messages of a round.
    """

    size: int
    rate: float
    count: int


@dataclass(frozen=True, slots=True)
class Turn:
    """One round of one way.

    Args:
        sent: Messages that were published.
        received: Of these, at each client that reads.
        unordered: Messages out of order or twice, at all of them.
        latency_ms: Median from when a message was due, at the client where it is largest.
        usage: Of the server.
    """

    sent: int
    received: tuple[int, ...]
    unordered: int
    latency_ms: float
    usage: Usage

    @property
    def cpu_us(self) -> float | None:
        """Processor time of the server for one message to one client, µs."""
        total = sum(self.received)
        return 1e6 * self.usage.cpu / total if total else None

    @property
    def lost(self) -> int:
        """Messages that did not come to a client that reads."""
        return self.sent * len(self.received) - sum(self.received)


@dataclass(slots=True)
class Way:
    """A server by one of its protocols.

    Args:
        server: Which.
        how: Which protocol and encoding.
    """

    server: WebServer
    how: How
    turns: list[Turn] = field(default_factory=list)

    @property
    def key(self) -> str:
        """For results."""
        return f"{self.server.key} {self.how}"

    @property
    def cpu_us(self) -> float | None:
        """The median over turns of what one message to one client costs the server, µs."""
        found = [cost for turn in self.turns if (cost := turn.cpu_us) is not None]
        return statistics.median(found) if found else None

    def measure(self, load: Load, clients: int, home: Path, *, stalled: int = 0) -> Turn:
        """One round with fresh clients, kept in ``turns``."""
        with self.server.readers(self.how, clients, stalled) as readers:
            self._warm_up(readers, load, home, stalled=stalled)
            turn = self._round(readers, load, home)
        self.turns.append(turn)
        return turn

    def _warm_up(self, readers: Process, load: Load, home: Path, *, stalled: int) -> None:
        few = Load(load.size, load.rate, _WARM_UP)
        for _ in range(_STALLED_TURNS if stalled else _WARM_TURNS):
            if all(self._round(readers, few, home).received):
                return
        if stalled:
            return  # that is a finding: the others get nothing
        raise BedError(f"{self.key}: not every client gets messages\n{readers.output[-2000:]}")

    def _round(self, readers: Process, load: Load, home: Path) -> Turn:
        number = time.monotonic_ns() % 1_000_000_000
        source = self.server.source
        since, sent_since = readers.mark_events(), source.mark_events()
        readers.tell(f"{number} 0")
        readers.wait_event("counting", since=since)
        meter = Meter({self.server.key: self.server.process.pid})
        source.tell(f"{number} {load.size} {load.rate} {load.count} {home / 'late'}")
        sent = source.wait_event("sent", load.count / load.rate + _WITHIN, since=sent_since)
        readers.tell(f"{number} {_SETTLE}")
        told = readers.wait_event("counted", _WITHIN, since=since)["clients"]
        usage = meter.read()[self.server.key]
        assert isinstance(told, list)
        return Turn(
            int(str(sent["count"])),
            tuple(int(client["count"]) for client in told),
            sum(int(client["unordered"]) for client in told),
            max(float(client["latency_ns"]) for client in told) / 1e6,
            usage,
        )


@dataclass(frozen=True, slots=True)
class Stall:
    """What a client that stops reading costs.

    Args:
        before: Peak of the server's resident memory without it, bytes.
        after: With it.
        turn: The round with it.
    """

    before: int
    after: int
    turn: Turn

    @property
    def growth_mb(self) -> float:
        """Megabytes (2^20 bytes)."""
        return (self.after - self.before) / (1 << 20)


def stall(way: Way, load: Load, clients: int, home: Path) -> Stall:
    """The same round without and with one more client, which subscribes and does not read."""
    with _peak(way.server.process.pid) as before:
        way.measure(load, clients, home)
    with _peak(way.server.process.pid) as after:
        turn = way.measure(load, clients, home, stalled=1)
    return Stall(before[0], after[0], turn)


@contextmanager
def _peak(pid: int) -> Iterator[list[int]]:
    """The largest resident memory of a process meanwhile, in a list of one."""
    process = psutil.Process(pid)
    found, ended = [process.memory_info().rss], threading.Event()

    def look() -> None:
        while not ended.wait(_SAMPLE):
            found[0] = max(found[0], process.memory_info().rss)

    thread = threading.Thread(target=look, name="memory", daemon=True)
    thread.start()
    try:
        yield found
    finally:
        ended.set()
        thread.join()
