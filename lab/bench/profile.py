"""What relaying a 64 B message costs an agent, and where that goes.

The cost is the scheduler's count for a stream at several rates, less what the agent uses without it: at low rates
each message pays a wake-up of its own, at high ones they share it. Where it goes is told by what the machine has,
each in a run of its own because each disturbs: ``perf`` (kernel, interpreter, extension modules), ``strace`` (system
calls a message), ``py-spy`` (Python functions), and ``cProfile`` (calls a message: exact counts, useless times).
"""

from __future__ import annotations

import pstats
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final

import psutil
from rich.console import Console

from lab import results
from lab.bed.agents import Agent
from lab.bed.bench import Bed
from lab.bed.processes import eventually
from lab.bed.ros import NODES
from lab.bench import schedule
from lab.bench.scale import per_message
from lab.figures import shapes
from lab.results import finish
from lab.tables import table_of, us
from lab.usage import Meter

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

_SIZE: Final = 64
_TOPIC: Final = "/profiled"
_PROFILED_RATE: Final = 2000.0
"""Hz while a profiler looks: many samples, and yet a wake-up for each message."""
_USUAL: Final = 1000.0
"""Hz of the cost that the picture divides; one of every plan's."""
_PERF_HZ: Final = 4999
_SPY_HZ: Final = 500
_ROWS: Final = 20
_WAITING: Final = ".select "
_TOOL_DEADLINE: Final = 60.0
_ATTACH: Final = 0.7
"""Seconds that ``strace`` gets to attach, and to let go."""


@dataclass(frozen=True, slots=True)
class ProfilePlan:
    """How much is measured.

    Args:
        rates: Of the stream, Hz, for the cost.
        seconds: At each rate.
        idle: Seconds without the stream.
        profiled: Seconds of each profiler.
    """

    rates: tuple[float, ...]
    seconds: float
    idle: float
    profiled: float


FULL: Final = ProfilePlan((100.0, _USUAL, 4000.0), 10.0, 10.0, 10.0)
QUICK: Final = ProfilePlan((_USUAL,), 3.0, 5.0, 2.0)


@dataclass(frozen=True, slots=True)
class Cost:
    """One agent at one rate, µs of processor time a message.

    Args:
        agent: Which.
        rate: Of the stream, Hz.
        total: User and system, less the idle cost.
        user: The share of the total that is spent in user space, 0 to 1.
        switches: Context switches a message: the wake-ups.
    """

    agent: str
    rate: float
    total: float
    user: float
    switches: float


@dataclass(slots=True)
class AgentProfile:
    """Where one agent's time goes.

    Args:
        objects: Share of samples by object: the kernel, the interpreter, libraries.
        symbols: Likewise by object and function.
        calls: System calls a message by name.
        functions: Share of samples by Python function, callees left out.
        modules: Likewise by file.
        counted: Calls a message by function.
        missing: Why a profiler did not run, by its name.
    """

    objects: dict[str, float] = field(default_factory=dict)
    symbols: dict[str, float] = field(default_factory=dict)
    calls: dict[str, float] = field(default_factory=dict)
    functions: dict[str, float] = field(default_factory=dict)
    modules: dict[str, float] = field(default_factory=dict)
    counted: dict[str, float] = field(default_factory=dict)
    missing: dict[str, str] = field(default_factory=dict)


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the tables, write the files; return the result."""
    plan = QUICK if quick else FULL
    profiles = {"agent 1": AgentProfile(), "agent 2": AgentProfile()}
    with Bed() as bed:
        way = schedule.agents(bed)
        stream = way.stream(bed, _TOPIC)
        pids = {f"agent {number}": agent.pid for number, agent in enumerate(way.agents, 1)}
        costs = list(relay_costs(stream, pids, plan))
        for name, pid in pids.items():
            console.print(f"looking into {name}", style="dim")
            _perf(profiles[name], pid, stream, plan.profiled, bed.home)
            _strace(profiles[name], pid, stream, plan.profiled, bed.home)
            _spy(profiles[name], pid, stream, plan.profiled, bed.home)
    _count_calls(profiles, plan.profiled)
    result: dict[str, object] = {
        "costs": [asdict(cost) for cost in costs],
        "profiles": {name: asdict(profile) for name, profile in profiles.items()},
    }
    with results.path_of("profile", ".txt").open("w", encoding="utf-8") as file:
        for where in (console, Console(file=file, width=130)):
            _show(where, costs, profiles)
    base = {cost.agent: cost.total for cost in costs if cost.rate == _USUAL}
    settings = {**asdict(plan), "bytes": _SIZE, "profiled_hz": _PROFILED_RATE}
    panels = shapes.bars(_parts(profiles, base), "µs of CPU a relayed message")
    return finish(console, "profile", settings, result, json, panels=panels)


# --- the cost -------------------------------------------------------------------------------------------------------


def relay_costs(stream: schedule.MeasuredStream, pids: Mapping[str, int], plan: ProfilePlan) -> Iterator[Cost]:
    """What a relayed message costs each agent, at each of the plan's rates."""
    stream.run(_SIZE, _USUAL, 1.0)
    meter = Meter(pids)
    time.sleep(plan.idle)
    idle = meter.read()
    processes = {name: psutil.Process(pid) for name, pid in pids.items()}
    for rate in plan.rates:
        before = {name: (one.cpu_times(), one.num_ctx_switches()) for name, one in processes.items()}
        arrivals = stream.run(_SIZE, rate, plan.seconds)
        for name, process in processes.items():
            times, switches = process.cpu_times(), process.num_ctx_switches()
            user, system = times.user - before[name][0].user, times.system - before[name][0].system
            switched = sum(switches) - sum(before[name][1])
            total = per_message(arrivals.usage[name], idle[name], arrivals.total)
            share = user / (user + system) if user + system else 0.0
            yield Cost(name, rate, round(total, 2), round(share, 3), round(switched / arrivals.total, 2))


# --- where it goes --------------------------------------------------------------------------------------------------


@contextmanager
def _streaming(stream: schedule.MeasuredStream, seconds: float) -> Iterator[None]:
    """A stream that lasts longer than what looks at it; it ends at the end."""
    stream.begin(_SIZE, _PROFILED_RATE, seconds + 2.0)
    stream.wait_lead_in(0.2)
    yield
    stream.end()


def _perf(into: AgentProfile, pid: int, stream: schedule.MeasuredStream, seconds: float, scratch: Path) -> None:
    if shutil.which("perf") is None:
        into.missing["perf"] = "not installed (apt install linux-perf)"
        return
    data = scratch / "perf.data"
    record = f"perf record -q -e cpu-clock -F {_PERF_HZ} -p {pid} -o".split()
    with _streaming(stream, seconds):
        done = _run([*record, data, "--", "sleep", str(seconds)])
    if done.returncode:
        into.missing["perf"] = done.stderr.strip()[-200:]
        return
    report: list[str | Path] = ["perf", "report", "--stdio", "-q", "-i", data, "--no-children", "-s"]
    into.objects = parse_perf(_run([*report, "dso"]).stdout)
    into.symbols = parse_perf(_run([*report, "dso,symbol"]).stdout)


def _strace(into: AgentProfile, pid: int, stream: schedule.MeasuredStream, seconds: float, scratch: Path) -> None:
    if shutil.which("strace") is None:
        into.missing["strace"] = "not installed (apt install strace)"
        return
    summary = scratch / "strace"
    tracer = subprocess.Popen(
        ["strace", "-c", "-f", "-p", str(pid), "-o", summary], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    try:
        time.sleep(_ATTACH)
        arrivals = stream.run(_SIZE, _USUAL, seconds)
    finally:
        tracer.send_signal(signal.SIGINT)
        _, errors = tracer.communicate(timeout=_TOOL_DEADLINE)
    calls = parse_strace(summary.read_text(encoding="utf-8")) if summary.exists() else {}
    if not calls:
        into.missing["strace"] = errors.decode(errors="replace").strip()[-200:]
        return
    into.calls = {name: round(count / arrivals.total, 3) for name, count in calls.items()}


def _spy(into: AgentProfile, pid: int, stream: schedule.MeasuredStream, seconds: float, scratch: Path) -> None:
    program = Path(sys.executable).with_name("py-spy")
    if not program.exists():
        into.missing["py-spy"] = "not installed (pip install -c constraints.txt -e '.[lab-peers]')"
        return
    raw = scratch / "spy"
    words = f"record -p {pid} -d {max(1, round(seconds))} -r {_SPY_HZ} -f raw -F -o".split()
    with _streaming(stream, seconds):
        done = _run([program, *words, raw])
    if done.returncode:
        into.missing["py-spy"] = done.stderr.strip()[-200:]
        return
    into.functions, into.modules = parse_stacks(raw.read_text(encoding="utf-8"))


def _count_calls(profiles: Mapping[str, AgentProfile], seconds: float) -> None:
    """Count with fresh agents, which start with the profiler's help."""
    with Bed() as bed:
        hosts = bed.lab.hosts("a", "b")
        agents = [_Counting(host, bed.home, name=host.name, log_level="warning") for host in hosts]
        try:
            for agent in agents:
                agent.start()
            for agent in agents:
                agent.wait_ready()
            agents[0].wait_peer(agents[1].name)
            here, there = (bed.shell(agent.host, agent.core_port) for agent in agents)
            stream = schedule.Way("counted", "counted", here, there, list(agents)).stream(bed, _TOPIC)
            stream.run(_SIZE, _USUAL, 1.0)
            for agent in agents:
                agent.process.send(signal.SIGUSR1)
            arrivals = stream.run(_SIZE, _USUAL, seconds)
            for agent in agents:
                agent.process.send(signal.SIGUSR2)
            for profile, agent in zip(profiles.values(), agents, strict=True):
                eventually(agent.stats.exists, what=f"the profile of {agent.name}")
                profile.counted = _calls(agent.stats, arrivals.total)
        finally:
            for agent in agents:
                agent.close()


class _Counting(Agent):
    """An agent under ``nodes/profiled.py``."""

    @property
    def stats(self) -> Path:
        """Where it writes what it counted."""
        return self.home / f"{self.name}.stats"

    @property
    def argv(self) -> list[str]:
        """As an agent's, through the interpreter."""
        words = super().argv
        at = next(number for number, word in enumerate(words) if word.endswith("/rmpa"))
        return [*words[:at], sys.executable, str(NODES / "profiled.py"), str(self.stats), *words[at + 1 :]]


def _calls(stats: Path, messages: int) -> dict[str, float]:
    """Calls a message of all that was called once in ten messages or more."""
    found: dict[str, float] = {}
    table: dict[tuple[str, int, str], tuple[int, int, float, float, object]] = vars(pstats.Stats(str(stats)))["stats"]
    for (file, line, name), (_, count, *_rest) in table.items():
        if count >= messages / 10:
            place = name if file == "~" else f"{name} ({_short(file)}:{line})"
            found[place] = round(count / messages, 2)
    return dict(sorted(found.items(), key=lambda pair: -pair[1]))


def _run(words: Iterable[str | Path]) -> subprocess.CompletedProcess[str]:
    argv = [str(word) for word in words]
    return subprocess.run(argv, capture_output=True, text=True, check=False, timeout=_TOOL_DEADLINE)


# --- what the tools write -------------------------------------------------------------------------------------------


def parse_perf(report: str) -> dict[str, float]:
    """Read ``perf report --stdio -q``: percent of the samples by what stands behind them."""
    rows = (re.match(r"\s*([\d.]+)%\s+(.*?)\s*(?:-\s+-\s*)?$", line) for line in report.splitlines())
    return {re.sub(r"\s+", " ", row[2]): float(row[1]) for row in rows if row}


def parse_strace(summary: str) -> dict[str, int]:
    """Read ``strace -c``: calls by name, most first."""
    wanted = re.compile(r"\s*[\d.]+\s+[\d.]+\s+\d+\s+(\d+)\s+(?:\d+\s+)?(\w+)\s*$")  # errors may be blank
    rows = (wanted.match(line) for line in summary.splitlines())
    found = {row[2]: int(row[1]) for row in rows if row and row[2] != "total"}
    return dict(sorted(found.items(), key=lambda pair: -pair[1]))


def parse_stacks(raw: str) -> tuple[dict[str, float], dict[str, float]]:
    """Read stacks as ``py-spy -f raw`` writes them: percent of samples by innermost function, and by its file."""
    functions: Counter[str] = Counter()
    modules: Counter[str] = Counter()
    for line in raw.splitlines():
        stack, _, count = line.rpartition(" ")
        frames = stack.split(";")
        # Threads beside the loop only wait, and so does its selector: py-spy cannot always tell that from work.
        if "run_forever" not in stack or _WAITING in frames[-1]:
            continue
        functions[frames[-1]] += int(count)
        if place := re.search(r"\((.*?)(?::\d+)?\)$", frames[-1]):
            modules[place[1]] += int(count)
    return _shares(functions), _shares(modules)


def _shares(counts: Counter[str]) -> dict[str, float]:
    whole = counts.total()
    return {name: round(100 * count / whole, 1) for name, count in counts.most_common()}


def _short(file: str) -> str:
    """The part of a path that tells the module."""
    for marker in ("/site-packages/", "/src/", "/lib/python3"):
        before, found, after = file.rpartition(marker)
        if found and before:
            return after.partition("/")[2] if marker == "/lib/python3" else after
    return file


# --- showing --------------------------------------------------------------------------------------------------------


def _show(console: Console, costs: list[Cost], profiles: Mapping[str, AgentProfile]) -> None:
    table = table_of(
        f"processor time of one agent for a relayed message of {_SIZE} B, µs; idle cost taken off",
        (),
        ("agent", "Hz", "user + system", "user, by ticks", "system, by ticks", "context switches"),
    )
    for cost in costs:
        parts = [us(value) for value in (cost.total, cost.total * cost.user, cost.total * (1 - cost.user))]
        table.add_row(cost.agent, f"{cost.rate:.0f}", *parts, f"{cost.switches:.2f}")
    console.print(table)
    for name, profile in profiles.items():
        looks = {
            "perf: % of samples by object": profile.objects,
            "perf: % of samples by function (what runs with interrupts off counts where they go on again:"
            " finish_task_switch and *_unlock_irq* are the wake-ups)": profile.symbols,
            "strace: system calls a message": profile.calls,
            "py-spy: % of samples by file, the wait in the selector left out": profile.modules,
            "py-spy: % of samples by function, likewise; system calls count for their caller": profile.functions,
            "cProfile: calls a message": profile.counted,
        }
        console.print(f"{name}", style="bold")
        for title, rows in looks.items():
            if rows:
                console.print(f"  {title}", style="dim")
            for what, value in list(rows.items())[:_ROWS]:
                console.print(f"  {value:8.2f}  {what}", markup=False, highlight=False)
        for tool, reason in profile.missing.items():
            console.print(f"  {tool} is left out: {reason}", style="yellow", markup=False)


def _parts(profiles: Mapping[str, AgentProfile], costs: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """The cost at 1 kHz by object, as ``perf`` divides it."""
    return {
        name: {what: costs[name] * share / 100 for what, share in profile.objects.items() if share >= 1.0}
        for name, profile in profiles.items()
        if name in costs and profile.objects
    }
