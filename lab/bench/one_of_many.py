"""One whole agent among up to 255 peers, the most of one mesh: processor time, wake-ups, memory, traffic at rest.

The agent is a real one, ``rmpa up`` in a network namespace with some topics of its own. Its peers are played by one
process in another namespace (``one_of_many_peers``), over real sockets: beacons, links, catalogues. So the
figures are those of the whole agent with its kernel calls, and those of the peers are not among them.
"""

from __future__ import annotations

import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import psutil

from lab.bed.bench import Bed
from lab.bed.processes import CommandFailed, Process, eventually
from lab.bench import fleet
from lab.findings import Claim
from lab.results import finish
from lab.tables import table_of
from rmpa.config.settings import Settings

if TYPE_CHECKING:
    from rich.console import Console

    from lab.bed.agents import Agent

_PEERS: Final = Path(__file__).with_name("one_of_many_peers.py")
_DEADLINE: Final = 600.0
_CPU_LIMIT: Final = 2.0
_RSS_LIMIT: Final = 100.0


@dataclass(frozen=True, slots=True)
class OneOfManyPlan:
    """How much is measured.

    Args:
        peers: The numbers of peers.
        topics: Of each module, the agent's own included.
        settle: Seconds from the last link to the measurement: all links are at rest then.
        idle: Seconds at rest.
    """

    peers: tuple[int, ...] = (63, 255)
    topics: int = 20
    settle: float = 60.0
    idle: float = 60.0


FULL: Final = OneOfManyPlan()
QUICK: Final = OneOfManyPlan(peers=(63,), settle=20.0, idle=20.0)


@dataclass(frozen=True, slots=True)
class AgentCost:
    """One number of peers.

    Args:
        linked: Seconds from the start of the peers, which announce themselves at 100 a second, until all had a link.
        joining_cpu: Its processor time from then until it was at rest, in seconds.
        cpu: Percent of a core, at rest.
        wakeups: A second, at rest.
        rss: Megabytes, at rest.
        rss_listed: Megabytes after it has told all that it knows of its peers, as ``rmpa peer list --json`` asks for.
        packets: A second, in and out, at rest.
        traffic: Bytes a second, in and out, at rest.
        load: The machine's load average over the last minute of the measurement.
    """

    linked: float
    joining_cpu: float
    cpu: float
    wakeups: float
    rss: float
    rss_listed: float
    packets: float
    traffic: float
    load: float


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the table, write the file; return the result."""
    plan = QUICK if quick else FULL
    rows: dict[int, AgentCost] = {}
    for peers in plan.peers:
        console.print(f"{peers} peers", style="dim")
        rows[peers] = _row(plan, peers)
    heads = ["peers", "all linked, s", "CPU until at rest, s", "CPU at rest, %", "wake-ups/s", "RSS, MB"]
    heads += ["once listed", "packets/s", "bytes/s", "load"]
    table = table_of(f"one agent among modules with {plan.topics} topics each, {plan.idle:.0f} s at rest", (), heads)
    for peers, row in rows.items():
        cells = [str(peers), f"{row.linked:.1f}", f"{row.joining_cpu:.1f}", f"{row.cpu:.2f}"]
        cells += [
            f"{row.wakeups:.1f}",
            f"{row.rss:.1f}",
            f"{row.rss_listed:.1f}",
            f"{row.packets:.0f}",
            f"{row.traffic:.0f}",
        ]
        table.add_row(*cells, f"{row.load:.1f}")
    console.print(table)
    most = max(rows)
    claims = [
        Claim(f"{most} peers: the whole agent at rest, % of a core", rows[most].cpu, _CPU_LIMIT),
        Claim(f"{most} peers: the whole agent, MB", rows[most].rss, _RSS_LIMIT),
    ]
    result: dict[str, object] = {"peers": {str(peers): asdict(row) for peers, row in rows.items()}}
    return finish(console, "one_of_many", asdict(plan), result, json, claims=claims)


def _row(plan: OneOfManyPlan, peers: int) -> AgentCost:
    with Bed() as bed:
        here, there = bed.lab.hosts("agent", "peers")  # the lower address is the agent's, so it dials
        agent = bed.agent(here, name="agent")
        fleet.populate([bed.shell(here, agent.core_port)], plan.topics)
        spent = _cpu(agent)
        group = Settings().multicast.group
        words = [there.address, str(peers), str(plan.topics), group, str(Settings().discovery_port)]
        with Process(there.command([sys.executable, _PEERS, *words]), name="the peers") as crowd:
            begun = time.monotonic()
            linked = _wait(crowd, "linked") - begun
            time.sleep(plan.settle)
            joining = _cpu(agent) - spent
            (cpu,), (woken,), (rss,), (packets,), (traffic,) = fleet.at_rest([agent], plan.idle)
            load = psutil.getloadavg()[0]
            _check(agent, peers, plan.topics)
            listed = psutil.Process(agent.pid).memory_info().rss / 1e6
    return AgentCost(
        linked=round(linked, 1),
        joining_cpu=round(joining, 1),
        cpu=cpu,
        wakeups=woken,
        rss=rss,
        rss_listed=round(listed, 1),
        packets=packets,
        traffic=traffic,
        load=round(load, 1),
    )


def _wait(crowd: Process, line: str) -> float:
    """Wait until the peers report this; return the monotonic time."""
    eventually(lambda: line in crowd.lines or crowd.returncode is not None, _DEADLINE, what=f"all peers {line}")
    if line not in crowd.lines:
        raise CommandFailed(f"the process of the peers has ended: {crowd.output[-2000:]}")
    return time.monotonic()


def _check(agent: Agent, peers: int, topics: int) -> None:
    """See that the agent knows all, and that nothing has changed meanwhile."""
    found = fleet.snapshot_of(agent)
    if found is None or not fleet.knows(found, peers, topics):
        raise CommandFailed("the agent does not know all topics of all peers")
    resting = sum(peer.link is not None and peer.link.rests for peer in found.peers)
    if resting != peers:
        raise CommandFailed(f"not all links are at rest, but {resting} of {peers}")


def _cpu(agent: Agent) -> float:
    """Seconds of processor time since its start."""
    times = psutil.Process(agent.pid).cpu_times()
    return times.user + times.system
