"""Experiment 5: 2 to 32 modules: latency, processor time, idle traffic, and how soon a module is in."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lab.bed.processes import Deadline, Process
from lab.experiments import flow
from lab.experiments.contenders import CLASSIC, COMPARED, DIRECT, RMPA, contender_of, system_of, transport_of
from lab.experiments.model import Cell, Measured, Results, Value
from lab.findings import Claim, Figure, Findings, Grid, Panel, Series
from lab.frames import counting_from, frame, latencies, lost
from lab.samples import summary
from lab.usage import Meter, Usage
from lab.words import counted

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from pandas import DataFrame

    from lab.bed.plan import Client, Plan
    from lab.bed.stage import Stage
    from lab.bed.system import System
    from lab.experiments.contenders import Contender

# The module that sends; with classic ROS it has the master.
FIRST: Final = "pc"
_HELLO, _PROBE = "/hello", "/probe"
_SIZE: Final = 64
# Hz: the time of the first message is known to 20 ms.
_HELLO_RATE: Final = 50.0
_PROBE_RATE: Final = 100.0
# Seconds of the probe flow that are thrown away.
_LEAD_IN: Final = 0.5
_UP_WITHIN: Final = 60.0
_JOINED_WITHIN: Final = 30.0
_LATENCY_LIMIT: Final = 1.1
_MESH_LIMIT: Final = 2.0
# Messages below which nothing is said of a latency.
_ENOUGH: Final = 500
# Percent of a core: where all agents of the test machine take more of it, the report says so.
_BUSY: Final = 50.0
_TRAFFIC: Final = ("tx_bytes", "rx_bytes", "tx_packets", "rx_packets")


@dataclass(frozen=True, slots=True)
class ScalingTimes:
    """How much is measured.

    Args:
        modules: The numbers of modules.
        joins: How often the last one is switched off and on.
        off: Seconds that it is off: its links have ended everywhere (their lease is 1 s).
        hello: Seconds of a round in which the first module sends to all; again until the one that joins heard it.
        settle: Seconds after the last join: bursts of beacons and first exchanges are over.
        idle: Seconds in which nothing happens: whole periods of what agents do now and then, as the heartbeat's 5 s.
        probe: Seconds of the probe flow.
    """

    modules: tuple[int, ...]
    joins: int
    off: float
    hello: float
    settle: float
    idle: float
    probe: float


_FULL: Final = ScalingTimes((2, 4, 8, 16, 32), 2, 2.5, 1.5, 3.0, 5.0, 10.0)
_SHORT: Final = ScalingTimes((2, 3), 1, 0.1, 1.0, 0.2, 0.5, 0.5)

_ABOUT: Final = """\
2 to 32 modules, each in a network namespace, all on this machine's processors. The first one (*pc*) sends to all
others when it is asked to; a node on each of them listens. For each number of modules classic ROS, RMPA through its
agents and RMPA direct, from node to node, in turns:

* the last module is switched off and on again: how long from its start until its node gets a message, and (RMPA)
  until every agent is linked with every other. A module of RMPA starts its agent and then its node, one of classic
  ROS only its node;
* **nothing** happens: what agents or the master use of the processors, and what crosses each module's cable;
* a **probe flow** of 64 B at 100 Hz runs from the first module to the second: its latency, from when each message was
  due.

Larger meshes are simulated with the agents' real protocol machines, up to 256 modules. With 256 and seed 1, 1 % of
the packets lost and all started within a second, all know all topics after 1.8 s; one that is killed is known to all
after 17 s, a third killed at once too (times of the simulated clock). `docs/guides/networks.md`, *How many
modules*, has the other sizes and what was not measured.
"""


class Scaling:
    """The experiment."""

    name: Final = "scaling"
    title: Final = "5. More modules"
    about: Final = _ABOUT

    def cells(self, plan: Plan) -> list[Cell]:
        """Each number of modules with all in turns, with the client that needs the least processor time."""
        times = _times(plan)
        client = "roscpp" if "roscpp" in plan.clients else plan.clients[0]
        fixed = times.joins * (times.off + times.hello + 2.0) + times.settle + times.idle + times.probe + 5.0
        return [
            Cell(
                self.name,
                {**one.kind_settings, "client": client, "modules": modules, "round": 1},
                fixed + modules * (1.0 if one.system == "rmpa" else 0.2),
            )
            for modules in times.modules
            for one in COMPARED
        ]

    def measure(self, cell: Cell, stage: Stage) -> Measured:
        """Join, idle, probe."""
        times = _times(stage.plan)
        client: Client = cell.settings["client"]  # type: ignore[assignment]  # cells() put it there
        hosts = [FIRST, *(f"m{number}" for number in range(2, int(str(cell.settings["modules"])) + 1))]
        with stage.system(system_of(cell), hosts, way=transport_of(cell)) as system:
            hello = _greet(system, client, stage)
            joins = [_join(system, client, stage, hello, times) for _ in range(times.joins)]
            sink = system.node(hosts[1], "sink", client, topics=_PROBE, nodelay=True)
            source = system.node(FIRST, "source", client, topic=_PROBE)
            flow.wait_flowing(source, sink, [_PROBE], stage.scratch)
            system.require_transport([(source, sink)])
            time.sleep(times.settle)
            idle, crossed = _idle(system, times.idle)
            meter = Meter({**system.pids(), "nodes: source": source.pid, "nodes: sink": sink.pid})
            count = round(_PROBE_RATE * (_LEAD_IN + times.probe))
            begun = flow.begin(source, stage.scratch, size=_SIZE, rate=_PROBE_RATE, count=count)
            sent = flow.sent(begun)
            busy = meter.read()
            system.require_transport([(source, sink)])
            came = flow.noted(sink, [_PROBE], stage.scratch, begun.number)
        lead = round(_PROBE_RATE * _LEAD_IN)
        usage = [("idle", idle), ("probe", busy)]
        tables = {
            "joins": frame(("ready_s", "linked_s", "first_s"), joins),
            "processes": frame(
                ("while", "process", "cpu_percent", "rss_bytes"),
                [(phase, name, used.percent, used.rss) for phase, found in usage for name, used in found.items()],
            ),
            "traffic": frame(("host", *(f"{name}_per_s" for name in _TRAFFIC)), crossed),
            "arrivals": counting_from(came, lead),
            "sent": counting_from(sent, lead),
        }
        return Measured(tables)

    def findings(self, results: Results) -> Findings:
        """Figures over the number of modules, the table and the claims."""
        steps = {
            (contender_of(cell), int(str(cell.settings["modules"]))): _step(measured)
            for cell, measured in results.cells
        }
        if not steps:
            return Findings()
        return Findings((_figure(steps),), (_grid(steps),), tuple(_claims(steps)), tuple(_notes(steps)))


def _times(plan: Plan) -> ScalingTimes:
    return _SHORT if plan.short else _FULL


# --- measuring ------------------------------------------------------------------------------------------------------


def _greet(system: System, client: Client, stage: Stage) -> Process:
    """Start the first module's source, and a sink on each other; return when all hear it."""
    others = [host for host in system.hosts if host != FIRST]
    sinks = [system.node(host, "sink", client, wait=False, topics=_HELLO, nodelay=True) for host in others]
    hello = system.node(FIRST, "source", client, topic=_HELLO)
    for sink in sinks:
        sink.wait_event("up", _UP_WITHIN)
    deadline = time.monotonic() + _JOINED_WITHIN
    while deaf := [sink.name for sink in sinks if not sink.events("first")]:
        if time.monotonic() > deadline:
            raise Deadline(f"nothing came to {', '.join(deaf)}")
        flow.sent(flow.begin(hello, stage.scratch, size=_SIZE, rate=_HELLO_RATE, count=5))
    return hello


def _join(system: System, client: Client, stage: Stage, hello: Process, times: ScalingTimes) -> tuple[Value, ...]:
    """Switch the last module off and on; seconds from its start until it is ready, linked, and hears."""
    last = system.hosts[-1]
    system.kill(last)
    time.sleep(times.off)
    count = round(times.hello * _HELLO_RATE)
    begun = flow.begin(hello, stage.scratch, size=_SIZE, rate=_HELLO_RATE, count=count)
    started = system.start(last)
    ready = time.monotonic()
    sink = system.node(last, "sink", client, wait=False, topics=_HELLO, nodelay=True)
    deadline = started + _JOINED_WITHIN
    while not sink.events("first") and time.monotonic() < deadline:
        flow.sent(begun)
        begun = flow.begin(hello, stage.scratch, size=_SIZE, rate=_HELLO_RATE, count=count)
    first = _number(sink.wait_event("first", 0.1)["came_ns"]) / 1e9
    linked = system.linked()
    flow.sent(begun)
    return ready - started, linked - started if system.kind == "rmpa" else None, first - started


def _idle(system: System, seconds: float) -> tuple[Mapping[str, Usage], list[tuple[Value, ...]]]:
    """What the system uses of the processors, and what crosses each cable in a second, while nothing happens."""
    before = {host: (time.monotonic(), system.traffic(host)) for host in system.hosts}
    meter = Meter(system.pids())
    time.sleep(seconds)
    used = meter.read()
    rows: list[tuple[Value, ...]] = []
    for host, (begun, old) in before.items():
        now, new = time.monotonic(), system.traffic(host)
        rows.append((host, *((new[name] - old[name]) / (now - begun) for name in _TRAFFIC)))
    return used, rows


def _number(value: object) -> int:
    return int(str(value))


# --- what follows ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ModulesStep:
    """One system with one number of modules.

    Args:
        latency: Of the probe flow, ms.
        lost: Messages of it that never came.
        idle: Percent of a core, each agent or the master with its helpers, while nothing happens.
        probe: The same while the probe flow runs.
        nodes: Percent of a core of the probe flow's two nodes.
        bytes: A second and module, both directions, while nothing happens.
        packets: Likewise.
        linked: Seconds from the start of the last module until all agents are linked, for each join.
        first: Seconds from there until its node hears the first module.
    """

    latency: Sequence[float]
    lost: int
    idle: Sequence[float]
    probe: Sequence[float]
    nodes: float
    bytes: float
    packets: float
    linked: Sequence[float]
    first: Sequence[float]

    @property
    def p50(self) -> float | None:
        """Of the latency."""
        return summary(self.latency).p50

    @property
    def p99(self) -> float | None:
        """Likewise."""
        return summary(self.latency).p99


def _step(measured: Measured) -> ModulesStep:
    """What one cell shows; classic ROS's master with its helpers counts as one."""
    used: dict[str, dict[str, float]] = {"idle": {}, "probe": {}}
    for phase, name, percent, _ in measured.tables["processes"].itertuples(index=False, name=None):
        what, _, host = str(name).partition("@")
        who = host if what == "agent" else "nodes" if what.startswith("nodes") else "master"
        used[str(phase)][who] = used[str(phase)].get(who, 0.0) + _float(percent)
    nodes = used["probe"].pop("nodes", 0.0)
    joins = measured.tables["joins"]
    return ModulesStep(
        latencies(measured.tables["arrivals"]),
        lost(measured.tables["arrivals"], measured.tables["sent"]),
        list(used["idle"].values()),
        list(used["probe"].values()),
        nodes,
        _crossing(measured.tables["traffic"], "bytes"),
        _crossing(measured.tables["traffic"], "packets"),
        [float(value) for value in joins["linked_s"].dropna()],
        joins["first_s"].tolist(),
    )


def _crossing(traffic: DataFrame, unit: str) -> float:
    """The mean over modules of what goes in and out in a second."""
    return float(sum(traffic[f"{way}_{unit}_per_s"].mean() for way in ("tx", "rx")))


def _float(value: object) -> float:
    return float(str(value))


Steps = dict[tuple["Contender", int], ModulesStep]


def _in_order(item: tuple[tuple[Contender, int], object]) -> tuple[int, int]:
    """By modules, then as the contenders take turns."""
    (contender, count), _ = item
    return count, COMPARED.index(contender)


def _figure(steps: Steps) -> Figure:
    modules = sorted({count for _, count in steps})
    ticks = {str(count): float(count) for count in modules}

    def lines(figure: str, *more: tuple[str, str]) -> tuple[Series, ...]:
        made = []
        for name, suffix in ((figure, ""), *more):
            for one in COMPARED:
                values = [(n, _of(steps.get((one, n)), name)) for n in modules]
                drawn = [(float(n), value) for n, value in values if value is not None]
                if drawn:
                    label = f"{one.label}{suffix}"
                    made.append(Series(label, [x for x, _ in drawn], [y for _, y in drawn], "line", one.look))
        return tuple(made)

    def panel(title: str, ylabel: str, series: tuple[Series, ...], *, logy: bool = False) -> Panel:
        return Panel(title, "modules", ylabel, series, logx=True, logy=logy, ticks=ticks)

    return Figure(
        "scaling",
        "What more modules cost",
        "Medians for joining, means for the rest; all modules share this machine's processors.",
        (
            panel("probe flow: latency, p50", "from due to there, ms", lines("p50")),
            panel("processor time, idle", "% of a core", lines("one", ("all", ", all together")), logy=True),
            panel("traffic of a module, idle", "KB/s, both directions", lines("kilobytes")),
            panel("from the start of the last module", "s", lines("first", ("linked", ", all agents linked"))),
        ),
        columns=2,
    )


def _of(step: ModulesStep | None, name: str) -> float | None:
    """One figure of a step by its name in the picture."""
    if step is None:
        return None
    found = {
        "p50": step.p50,
        "one": statistics.fmean(step.idle) if step.idle else None,
        "all": sum(step.idle) if step.idle else None,
        "kilobytes": step.bytes / 1000,
        "first": statistics.median(step.first) if step.first else None,
        "linked": statistics.median(step.linked) if step.linked else None,
    }
    return found[name]


def _grid(steps: Steps) -> Grid:
    heads = ("modules", "system", "p50, ms", "p99", "lost", "idle: % of a core, mean", "most", "all", "probe: all")
    more = ("its two nodes", "idle: bytes/s", "packets/s", "last start to all linked, s", "to its first message")
    rows = []
    for (one, count), step in sorted(steps.items(), key=_in_order):
        figures = [counted(step.p50), counted(step.p99), str(step.lost)]
        used = [_of(step, "one"), max(step.idle, default=None), _of(step, "all"), sum(step.probe), step.nodes]
        joined = [counted(_of(step, "linked")), counted(_of(step, "first"))]
        crossed = [f"{step.bytes:.0f}", f"{step.packets:.1f}"]
        rows.append((str(count), one.label, *figures, *(counted(value) for value in used), *crossed, *joined))
    note = (
        "Processor time is of what the system itself runs: agents, or roscore, rosmaster and rosout; idle, and"
        " with the probe flow. Traffic is a module's mean, in and out: with RMPA the discovery's beacons and the"
        " links' keepalives, which every pair of modules has."
    )
    return Grid("What more modules cost", (*heads, *more), rows, note)


def _claims(steps: Steps) -> Iterable[Claim]:
    counts = sorted({count for _, count in steps})
    for contender in (RMPA, DIRECT):
        for many in counts[1:] if any(one == contender for one, _ in steps) else ():
            ours, theirs = (
                _ratio(steps.get((one, many)), steps.get((one, counts[0]))) for one in (contender, CLASSIC)
            )
            value = ours / theirs if ours is not None and theirs else None
            text = f"latency p50 with {many} modules / with {counts[0]}, {contender.label}, by classic's own ratio"
            yield Claim(text, value, _LATENCY_LIMIT)
    for many in counts:
        linked = _of(steps.get((RMPA, many)), "linked")
        yield Claim(f"{many} modules: last start to all linked, median, RMPA", linked, _MESH_LIMIT, unit="s")


def _ratio(step: ModulesStep | None, base: ModulesStep | None) -> float | None:
    """Of the medians; ``None`` where one of them rests on few messages."""
    ours, theirs = (one.p50 if one and len(one.latency) >= _ENOUGH else None for one in (step, base))
    return ours / theirs if ours is not None and theirs else None


def _notes(steps: Steps) -> Iterable[str]:
    yield (
        "All modules share this machine's processors; on a robot each brings its own. With RMPA a module joins later"
        " by what its agent takes to be loaded; classic ROS's master was there before."
    )
    for (one, count), step in sorted(steps.items(), key=_in_order):
        if one == RMPA and sum(step.idle) > _BUSY:
            yield (
                f"With {count} modules the agents together use {sum(step.idle):.0f} % of a core while nothing"
                " happens: each pair of them keeps a link. The probe flow waits for"
                f" those processors; its figure is of this machine, and {statistics.fmean(step.idle):.2g} % is what"
                " each module would notice."
            )


EXPERIMENT: Final = Scaling()
