"""How long a service call takes by RMPA, relayed and direct, beside classic ROS: both ends are roscpp nodes.

A call of its own connection asks the master where the server is, connects, says its header and calls; a persistent
one only calls. With classic ROS both hosts have one rosmaster; with RMPA each has its agent's core.
"""

from __future__ import annotations

import time
from array import array
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from lab import samples, tables
from lab.bed.bench import TEST_NODES, Bed
from lab.bed.processes import BedError, Process
from lab.findings import Claim
from lab.results import finish
from lab.tables import table_of

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from lab.bed.agents import Agent
    from lab.bed.plan import Transport
    from lab.bed.ros import Ros

_SIZES: Final = (64, 64 * 1024, 1024 * 1024)
_HOWS: Final = ("once", "persistent")
_TARGET: Final = 2.0
# Of persistent calls: what one of its own connection asks of the core costs the same by either transport.
_DIRECT_TARGET: Final = 1.1
# Seconds until calls go straight to the server.
_DIRECT_WITHIN: Final = 20.0
# Calls of each turn that are thrown away.
_WARM_UP: Final = 20


@dataclass(frozen=True, slots=True)
class ServicesPlan:
    """How much is measured.

    Args:
        calls: By size in bytes, over all rounds.
        rounds: Turns of each way.
    """

    calls: dict[int, int]
    rounds: int


FULL: Final = ServicesPlan(dict(zip(_SIZES, (3000, 1500, 400), strict=True)), 10)
QUICK: Final = ServicesPlan(dict(zip(_SIZES, (200, 100, 30), strict=True)), 2)


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure both ways in turns, print the table, write the file; return the result."""
    plan = QUICK if quick else FULL
    took: dict[tuple[str, str, int], list[float]] = {}
    failed = 0
    with Bed() as bed:
        ways = {
            "direct": ServiceWay(_ends(*reversed(bed.classic()))),
            "agents": _agents(bed, "relay", 1),
            "agents_direct": _agents(bed, "direct", 2),
        }
        for way in ways.values():
            way.wait_transport(bed)
        for turn in range(plan.rounds):
            first = turn % len(ways)
            for name in [*ways, *ways][first : first + len(ways)]:
                for how in _HOWS:
                    for size, calls in plan.calls.items():
                        new, bad = ways[name].round(bed, how, size, calls // plan.rounds)
                        took.setdefault((name, how, size), []).extend(new)
                        failed += bad
    result = _show(console, took)
    targets = [
        Claim(f"a call of {size} bytes ({how}), {text}, p50", tables.ratio(*medians), limit)
        for key, text, hows, limit in (
            ("agents", "agents / direct", _HOWS, _TARGET),
            ("agents_direct", "RMPA direct / roscpp direct", ("persistent",), _DIRECT_TARGET),
        )
        for how in hows
        for size in plan.calls
        for medians in [[_p50(took[of, how, size]) for of in (key, "direct")]]
    ]
    document: dict[str, object] = {"calls": result, "failed": failed}
    return finish(console, "services", asdict(plan), document, json, claims=targets)


@dataclass(slots=True)
class ServiceWay:
    """One way from caller to server.

    Args:
        asker: Calls.
        agent: The caller's; ``None`` in classic ROS.
        transport: How calls cross where there are agents.
    """

    asker: Process
    agent: Agent | None = None
    transport: Transport = "relay"

    def round(self, bed: Bed, how: str, size: int, calls: int) -> tuple[list[float], int]:
        """Microseconds of each call behind the warm-up, and how many failed.

        Raises:
            BedError: They crossed otherwise than they should.
        """
        path = bed.home / "calls"
        before, since = self._relayed(), self.asker.mark_events()
        self.asker.tell(f"{size} {calls + _WARM_UP} {how} {path}")
        event = self.asker.wait_event("round", 120.0, since=since)
        crossed = self._relayed() - before
        if self.agent and bool(crossed) != (self.transport == "relay"):
            raise BedError(f"transport {self.transport}, but {crossed} calls of {calls + _WARM_UP} were relayed")
        times = array("Q", path.read_bytes())
        return [ns / 1e3 for ns in times[_WARM_UP:]], int(str(event["failed"]))

    def wait_transport(self, bed: Bed) -> None:
        """Return when calls cross as they should.

        Raises:
            BedError: They do not.
        """
        deadline = time.monotonic() + _DIRECT_WITHIN
        while True:
            try:
                self.round(bed, "persistent", 64, 1)
            except BedError:
                if time.monotonic() > deadline:
                    raise
            else:
                return

    def _relayed(self) -> int:
        """How many calls the caller's agent has relayed."""
        return sum(info.calls for info in self.agent.snapshot().services) if self.agent else 0


def _agents(bed: Bed, transport: Transport, network: int) -> ServiceWay:
    """Two modules."""
    a, b = bed.lab.hosts(f"{transport}_a", f"{transport}_b", network=network)
    first, second = (bed.agent(host, name=host.name, way=transport) for host in (a, b))
    first.wait_peer(second.name)
    return ServiceWay(_ends(bed.shell(a), bed.shell(b)), second, transport)


def _ends(serving: Ros, calling: Ros) -> Process:
    serving.roscpp("worker", nodes=TEST_NODES, quiet=True).wait_event("up")
    asker = calling.roscpp("asker", commands=True)
    asker.wait_event("ready")
    return asker


def _p50(times: list[float]) -> float | None:
    return samples.summary(times).p50


def _show(console: Console, took: dict[tuple[str, str, int], list[float]]) -> list[dict[str, object]]:
    table = table_of(
        "a call of rmpa_test/Work, µs", ("way", "connection", "bytes each way"), ("p50", "p99", "max", "calls")
    )
    rows: list[dict[str, object]] = []
    for (name, how, size), times in sorted(took.items(), key=lambda item: (item[0][2], item[0][1], item[0][0])):
        summary = samples.summary(times)
        table.add_row(name, how, str(size), *map(tables.us, (summary.p50, summary.p99, max(times))), str(len(times)))
        rows.append({"way": name, "connection": how, "bytes": size, "us": asdict(summary)})
    console.print(table)
    return rows
