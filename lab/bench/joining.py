"""How soon modules are joined, and what that costs while nothing happens: 2 to 16 modules, each in its namespace.

For each number of modules: from the start of the last one to the full mesh (every pair linked); the same where all
start at once, also from the moment when the last one was ready (all share this machine's cores); then processor time
and traffic of each agent while nothing happens. And how soon the graph of one module (50 nodes, 500 topics, 100
services) is there at another one that joins.
"""

from __future__ import annotations

import json as jsons
import statistics
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from lab.bed.agents import last_link
from lab.bed.bench import Bed
from lab.bed.ros import NODES
from lab.findings import Claim
from lab.results import finish
from lab.tables import table_of
from lab.usage import Meter
from rmpa.core.errors import RmpaError
from rmpa.observe.io.control_client import ControlClient

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from lab.bed.agents import Agent
    from rmpa.observe.snapshot import Snapshot

_MESH_WITHIN: Final = 2.0
_MIRRORED_WITHIN: Final = 1.0
_DEADLINE: Final = 120.0
_SETTLE: Final = 4.0
"""Seconds after the last link: the burst of beacons and the first exchange are over."""
_LOOK: Final = 0.1
"""Seconds between looks at the agents; the times themselves are the agents' own."""
_INTERFACE: Final = "eth0"


@dataclass(frozen=True, slots=True)
class JoiningPlan:
    """How much is measured.

    Args:
        modules: The numbers of modules.
        joins: How often the last one joins, at each number.
        idle: Seconds without anything: whole periods of what an agent does now and then, as the heartbeat's 5 s.
        mirrors: How often a module joins one that has a graph.
        nodes: Of that graph.
        topics: Likewise, over all nodes.
        services: Likewise.
    """

    modules: tuple[int, ...] = (2, 4, 8, 16)
    joins: int = 5
    idle: float = 20.0
    mirrors: int = 5
    nodes: int = 50
    topics: int = 500
    services: int = 100


FULL: Final = JoiningPlan()
QUICK: Final = JoiningPlan(modules=(2, 4, 16), joins=1, idle=5.0, mirrors=1)


@dataclass(frozen=True, slots=True)
class Traffic:
    """What crossed a module's interface, both ways."""

    packets: int
    bytes: int


@dataclass(slots=True)
class Row:
    """One number of modules.

    Args:
        joins: Seconds from the start of the last agent's program to the full mesh.
        ready: Seconds from there to READY=1, for each of these.
        together: The same where all start at once, from the last start.
        together_ready: The same, from the moment when the last one was ready.
        cpu: Percent of a core, each agent.
        traffic: Bytes a second in and out, each agent.
        packets: Packets a second in and out, each agent.
    """

    joins: list[float]
    ready: list[float]
    together: float
    together_ready: float
    cpu: list[float]
    traffic: list[float]
    packets: list[float]


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the tables, write the file; return the result."""
    plan = QUICK if quick else FULL
    rows = {count: _modules(plan, count, console) for count in plan.modules}
    mirrors = [_mirror(plan) for _ in range(plan.mirrors)]
    console.print(_table(rows, plan))
    console.print(_mirror_table(mirrors, plan))
    most = max(rows)
    result: dict[str, object] = {
        "modules": {str(count): asdict(row) for count, row in rows.items()},
        "mirrored": mirrors,
    }
    return finish(
        console,
        "joining",
        asdict(plan),
        result,
        json,
        claims=[
            Claim(f"{most} modules: last start to full mesh, median, s", _median(rows[most].joins), _MESH_WITHIN),
            Claim(f"{most} modules at once: last READY to mesh, s", rows[most].together_ready, _MESH_WITHIN),
            *(
                Claim(f"{what} mirrored, from the link, median, s", _median(times), _MIRRORED_WITHIN)
                for what in ("topics", "services")
                if (times := [seconds for one in mirrors if (seconds := one[what]) is not None])
            ),
        ],
    )


# --- modules --------------------------------------------------------------------------------------------------


def _modules(plan: JoiningPlan, count: int, console: Console) -> Row:
    console.print(f"{count} modules", style="dim")
    with Bed() as bed:
        hosts = bed.lab.hosts(*(f"m{number}" for number in range(count)))
        agents = [bed.agent(host, name=host.name, start=False) for host in hosts]
        for agent in agents:
            agent.start()
        with ThreadPoolExecutor(count) as waiting:  # each is seen when it is ready, not when its turn comes
            list(waiting.map(lambda agent: agent.wait_ready(_DEADLINE), agents))
        whole = meshed(agents)
        together = whole - max(agent.process.started for agent in agents)
        together_ready = whole - max(agent.process.started + agent.ready_after for agent in agents)
        joins, ready = [], []
        last = agents[-1]
        for _ in range(plan.joins):
            last.process.end()
            _wait_without(agents[:-1], last.name)
            last.start()
            last.wait_ready(_DEADLINE)
            ready.append(last.ready_after)
            joins.append(meshed(agents) - last.process.started)
        time.sleep(_SETTLE)
        before, meter = [_traffic(agent) for agent in agents], Meter({agent.name: agent.pid for agent in agents})
        begun = time.monotonic()
        time.sleep(plan.idle)
        usage = meter.read().values()
        spent = [_traffic(agent) for agent in agents]
        seconds = time.monotonic() - begun
        moved = list(zip(before, spent, strict=True))
        return Row(
            _rounded(joins),
            _rounded(ready),
            round(together, 3),
            round(max(0.0, together_ready), 3),
            _rounded([one.percent for one in usage]),
            _rounded([(after.bytes - start.bytes) / seconds for start, after in moved], 1),
            _rounded([(after.packets - start.packets) / seconds for start, after in moved], 1),
        )


def meshed(agents: Sequence[Agent]) -> float:
    """Wait until every agent is linked with all others; the monotonic time at which the last link came up."""
    names = {agent.name for agent in agents}
    came = {}
    deadline = time.monotonic() + _DEADLINE
    for agent in reversed(agents):  # the one that came last is the last to know all
        while (up := last_link(_snapshot(agent), names - {agent.name}, time.monotonic())) is None:
            if time.monotonic() > deadline:
                raise TimeoutError(f"{agent.name} is not linked with all others after {_DEADLINE:g} s")
            time.sleep(_LOOK)
        came[agent.name] = up
    return max(came.values())


def _wait_without(agents: Sequence[Agent], name: str) -> None:
    """Wait until no agent has a link to a peer any more."""
    for agent in agents:
        while (found := _snapshot(agent)) is None or any(p.name == name and p.link for p in found.peers):
            time.sleep(_LOOK)


def _snapshot(agent: Agent) -> Snapshot | None:
    """What an agent says of itself: by its socket, for a hundred ``rmpa peer list`` would be what is measured."""
    try:
        with ControlClient(agent.sockets()[0]) as client:
            return client.snapshot()
    except (RmpaError, IndexError):
        return None


def _traffic(agent: Agent) -> Traffic:
    (link,) = jsons.loads(agent.host.ip("-s", "-j", "link", "show", _INTERFACE))
    ways = [link["stats64"][way] for way in ("rx", "tx")]
    return Traffic(sum(way["packets"] for way in ways), sum(way["bytes"] for way in ways))


# --- a graph --------------------------------------------------------------------------------------------------


def _mirror(plan: JoiningPlan) -> dict[str, float | None]:
    """Seconds from the link of a joining module to all topics, and to all services, in its graph; from its start."""
    with Bed() as bed:
        there, joins = bed.lab.hosts("there", "joins")
        first = bed.agent(there, name="there")
        words = ["--per-node", str(plan.topics // plan.nodes), "--services", str(plan.services // plan.nodes)]
        crowd = bed.shell(there).start(sys.executable, NODES / "crowd.py", *words, name="crowd", commands=True)
        crowd.tell(str(plan.topics))
        crowd.wait_event("registered", _DEADLINE)
        wanted = ["--topics", str(plan.topics), "--services", str(plan.services)]
        probe = bed.shell(joins).start(sys.executable, NODES / "mirrored.py", *wanted, name="mirrored")
        probe.wait_event("up")
        second = bed.agent(joins, name="joins")
        topics = float(str(probe.wait_event("topics", _DEADLINE)["at"]))
        services = float(str(probe.wait_event("services", _DEADLINE)["at"]))
        linked = meshed([first, second])
        started = second.process.started
        return {
            "topics": round(topics - linked, 3),
            "services": round(services - linked, 3),
            "topics_from_start": round(topics - started, 3),
            "services_from_start": round(services - started, 3),
        }


# --- tables ---------------------------------------------------------------------------------------------------


def _table(rows: dict[int, Row], plan: JoiningPlan) -> Table:
    heads = ["modules", "last start to mesh, s", "worst", "its READY, s", "all at once, s", "after READY"]
    heads += ["CPU mean, %", "worst"]
    table = table_of(
        f"full mesh (to reach: {_MESH_WITHIN:g} s), and each agent over {plan.idle:.0f} s of nothing",
        (),
        (*heads, "bytes/s", "packets/s"),
    )
    for count, row in rows.items():
        joins = [f"{_median(row.joins):.2f}", f"{max(row.joins):.2f}", f"{_median(row.ready):.2f}"]
        once = [f"{row.together:.2f}", f"{row.together_ready:.2f}"]
        cpu = [f"{statistics.fmean(row.cpu):.2f}", f"{max(row.cpu):.2f}"]
        moved = [f"{statistics.fmean(row.traffic):.0f}", f"{statistics.fmean(row.packets):.1f}"]
        table.add_row(str(count), *joins, *once, *cpu, *moved)
    return table


def _mirror_table(mirrors: Sequence[dict[str, float | None]], plan: JoiningPlan) -> Table:
    title = f"a graph of {plan.nodes} nodes at a module that joins (to reach: {_MIRRORED_WITHIN:g} s from its link)"
    table = table_of(title, ("what",), ("from the link, s", "worst", "from its start, s"))
    for what, count in (("topics", plan.topics), ("services", plan.services)):
        times = [seconds for one in mirrors if (seconds := one[what]) is not None]
        starts = [seconds for one in mirrors if (seconds := one[f"{what}_from_start"]) is not None]
        table.add_row(f"{count} {what}", f"{_median(times):.2f}", f"{max(times):.2f}", f"{_median(starts):.2f}")
    return table


def _median(values: Sequence[float]) -> float:
    return statistics.median(values)


def _rounded(values: Sequence[float], digits: int = 3) -> list[float]:
    return [round(value, digits) for value in values]
