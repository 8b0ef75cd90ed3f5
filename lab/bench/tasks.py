"""How evenly a periodic task runs, and how late: a resource's at 100 Hz, beside loops of rospy.Rate and ros::Rate.

Each publishes a message of 64 B each time, to a roscpp subscriber. The loops take turns; the resource's task goes on
meanwhile, for a resource has no pause. Each is late by its own clock, against the time at which it was due by its own
schedule: rospy's and roscpp's loops follow the wall clock, a resource's task the monotonic one.
"""

from __future__ import annotations

import itertools
import statistics
import subprocess
from array import array
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Final

from lab import samples
from lab.bed.agents import RMPA
from lab.bed.bench import Bed
from lab.bed.ros import NODES
from lab.bench import schedule
from lab.figures import shapes
from lab.findings import Claim
from lab.results import finish
from lab.tables import dash, ratio, table_of, us, usage_row
from lab.usage import Meter, Usage, add

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from lab.bed.processes import Process

_TITLES: Final = {"resource": "task of a resource", "rospy": "rospy.Rate", "roscpp": "ros::Rate"}
_RATE: Final = 100
_HELLO: Final = 30.0


FULL: Final = schedule.Rounds(5.0, 12)
QUICK: Final = schedule.Rounds(1.5, 4)


@dataclass(slots=True)
class Loop:
    """One of them, over all its turns; µs."""

    periods: array[float] = field(default_factory=lambda: array("d"))
    late: array[float] = field(default_factory=lambda: array("d"))
    deviations: list[float] = field(default_factory=list)
    lateness: list[float] = field(default_factory=list)
    usage: dict[str, Usage] = field(default_factory=dict)

    def take(self, path: Path, usage: dict[str, Usage]) -> None:
        """One turn, as the node wrote it."""
        noted = array("Q", path.read_bytes())
        due, began = noted[::2], noted[1::2]
        periods = [(b - a) / 1e3 for a, b in itertools.pairwise(began)]
        late = [(b - d) / 1e3 for d, b in zip(due, began, strict=True)]
        self.periods.extend(periods)
        self.late.extend(late)
        self.deviations.append(statistics.stdev(periods))
        self.lateness.append(statistics.fmean(late))
        self.usage = add(self.usage, usage)

    @property
    def sd(self) -> float:
        """Of the period: the median over turns."""
        return statistics.median(self.deviations)

    @property
    def mean_late(self) -> float:
        """Likewise of each turn's mean lateness."""
        return statistics.median(self.lateness)


def measure(quick: bool, console: Console, json: Path | None = None, *, realtime: bool = False) -> dict[str, object]:
    """Measure, print the table, write the files; return the result."""
    plan = QUICK if quick else FULL
    host = schedule.HostLateness()
    loops = {name: Loop() for name in _TITLES}
    with Bed() as bed:
        processes = _start(bed)
        for process in processes.values() if realtime else ():
            chrt = ["chrt", "--all-tasks", "--fifo", "--pid", str(schedule.NODE_PRIORITY), str(process.pid)]
            subprocess.run(chrt, check=True, timeout=10)
        path = bed.home / "noted"
        for turn in range(plan.rounds):
            order = list(loops)[turn % 3 :] + list(loops)[: turn % 3]
            for name in order:
                process = processes[name]
                since = process.mark_events()
                meter = Meter({name: process.pid})
                process.tell(f"{round(plan.seconds * _RATE)} {path}")
                process.wait_event("done", plan.seconds + _HELLO, since=since)
                loops[name].take(path, meter.read())
    ours, base = loops["resource"], loops["rospy"]
    console.print(_table(loops))
    targets = [
        Claim(f"period sd at {_RATE} Hz, a resource's task / rospy.Rate", ratio(ours.sd, base.sd), 1.0),
        Claim(f"lateness at {_RATE} Hz, a resource's task / rospy.Rate", ratio(ours.mean_late, base.mean_late), 1.0),
    ]
    result: dict[str, object] = {
        "rows": [_row(name, loop, loops) for name, loop in loops.items()],
        **host.finish(console),
    }
    panels: dict[str, Mapping[str, Sequence[float]]] = {
        "lateness": {_TITLES[name]: loop.late for name, loop in loops.items()},
        "distance from the period": {
            _TITLES[name]: [abs(period - 1e6 / _RATE) for period in loop.periods] for name, loop in loops.items()
        },
    }
    return finish(
        console,
        schedule.named("tasks", realtime=realtime),
        {**asdict(plan), "hz": _RATE},
        result,
        json,
        claims=targets,
        panels=shapes.shares(panels, "µs"),
    )


def _start(bed: Bed) -> dict[str, Process]:
    """All three on one rosmaster, each with a subscriber of its own."""
    shell = bed.shell()
    shell.master()
    environment = {"RMPA_BENCH_RATE": str(_RATE), "XDG_STATE_HOME": str(bed.home), "XDG_RUNTIME_DIR": str(bed.home)}
    processes = {
        "resource": shell.start(
            RMPA,
            "run",
            NODES / "timed_task.py",
            "--master",
            shell.uri,
            name="timed_task.py",
            env=environment,
            commands=True,
        ),
        "rospy": shell.rospy("timed_loop", commands=True, topic="/rated/rospy", rate=_RATE),
        "roscpp": shell.roscpp("timed_loop", commands=True, topic="/rated/roscpp", rate=_RATE),
    }
    for name in processes:
        shell.roscpp("counter", topic=f"/rated/{name}").wait_event("up", _HELLO)
    for name in ("rospy", "roscpp"):
        processes[name].wait_event("connected", _HELLO)
    processes["resource"].wait_for("active on", _HELLO)
    return processes


def _row(name: str, loop: Loop, loops: dict[str, Loop]) -> dict[str, object]:
    return {
        "loop": name,
        "period_us": asdict(samples.summary(loop.periods)),
        "late_us": asdict(samples.summary(loop.late)),
        "sd_us": loop.sd,
        "sd_by_turn_us": loop.deviations,
        "mean_late_us": loop.mean_late,
        "sd_to_rospy": ratio(loop.sd, loops["rospy"].sd),
        "late_to_rospy": ratio(loop.mean_late, loops["rospy"].mean_late),
        "process": usage_row(loop.usage[name], len(loop.late)),
    }


def _table(loops: dict[str, Loop]) -> Table:
    heads = (
        "period sd",
        "to rospy",
        "late, mean",
        "to rospy",
        "late p50",
        "p99",
        "p99.9",
        "max",
        "CPU a run",
        "runs",
    )
    table = table_of(f"a loop at {_RATE} Hz, µs; sd and mean: median over turns", ("loop",), heads)
    base = loops["rospy"]
    for name, loop in loops.items():
        late = samples.summary(loop.late)
        table.add_row(
            _TITLES[name],
            us(loop.sd),
            dash(ratio(loop.sd, base.sd)),
            us(loop.mean_late),
            dash(ratio(loop.mean_late, base.mean_late)),
            *map(us, (late.p50, late.p99, late.p999, late.largest)),
            us(1e6 * loop.usage[name].cpu / max(1, late.count)),
            str(late.count),
        )
    return table
