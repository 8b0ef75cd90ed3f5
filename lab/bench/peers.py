"""Who else carries bytes from process to process, each at its best, in the same run as two agents.

Round trips as in ``path``. The libraries go straight from one process to the other; through two agents a message
passes two processes more, and both ends stay unmodified ROS nodes. The libraries come with the extra "lab-peers".
"""

from __future__ import annotations

import importlib.util
import sys
from array import array
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Final

from rich.table import Table

from lab import plot, results, samples, tables
from lab.bed.bench import Bed, why_no_hosts, why_no_ros
from lab.bed.processes import Deadline
from lab.bed.ros import NODES, free_port
from lab.bench import contenders
from lab.bench.contenders import Contender
from lab.bench.schedule import HostLateness
from lab.usage import Usage, add

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from rich.console import Console

    from lab.bed.processes import Process

_SIZES: Final = (64, 64 * 1024, 1024 * 1024)
_WARM_UP: Final = 20
"""Round trips of each turn that are thrown away."""
_BASE: Final = "roscpp_nodelay"
_OURS: Final = "agents_hosts"
_INSTALL: Final = "pip install -c constraints.txt -e '.[lab-peers]'"


@dataclass(frozen=True, slots=True)
class Plan:
    """How much is measured.

    Args:
        trips: Round trips by size in bytes, over all rounds.
        rounds: Turns of each.
    """

    trips: dict[int, int]
    rounds: int


FULL: Final = Plan(dict(zip(_SIZES, (12_000, 3_000, 1_000), strict=True)), 10)
QUICK: Final = Plan(dict(zip(_SIZES, (1_000, 300, 60), strict=True)), 2)


def zenoh(*flags: str) -> Callable[[Bed], Contender]:
    """Eclipse Zenoh, peer to peer over TCP; with ``--shared-memory`` large messages bypass it."""

    def start(bed: Bed) -> Contender:
        words = [str(free_port()), *flags]
        title = "zenoh (Python), shared memory" if flags else "zenoh (Python), TCP"
        return _library(bed, "zenoh_shm" if flags else "zenoh", title, "ping_zenoh.py", words, freeze=False)

    return start


def cyclonedds(bed: Bed) -> Contender:
    """CycloneDDS, reliable and keep-last, over loopback alone, in a domain of our own."""
    words = [str(free_port() % 200 + 20), *map(str, _SIZES)]
    return _library(bed, "cyclonedds", "cyclonedds (Python), reliable", "ping_dds.py", words, freeze=False)


def zeromq(bed: Bed) -> Contender:
    """ZeroMQ, a PAIR over TCP."""
    return _library(bed, "pyzmq", "pyzmq, PAIR over TCP", "ping_zmq.py", [], freeze=True)


def _library(bed: Bed, key: str, title: str, program: str, words: list[str], *, freeze: bool) -> Contender:
    """Start both ends; those that watch each other's life cannot be stopped while others are measured."""
    shell = bed.shell()
    server = shell.start(sys.executable, NODES / program, "serve", *words, name=f"{key} pong")
    up = server.wait_event("up")
    words = [str(up["port"])] if "port" in up else words
    ping = shell.start(sys.executable, NODES / program, "ping", *words, name=f"{key} ping", commands=True)
    ping.wait_event("ready", 30.0)
    ends: dict[str, Process] = {"ping": ping, "pong": server}
    return Contender(key, title, ping, ends, list(ends.values()) if freeze else [])


@dataclass(frozen=True, slots=True)
class Entry:
    """One that takes part.

    Args:
        start: Starts its processes.
        module: The Python module that it needs, or empty.
        needs: Each says why it cannot run here, or an empty string.
    """

    start: Callable[[Bed], Contender]
    module: str = ""
    needs: tuple[Callable[[], str], ...] = ()

    def why_not(self) -> str:
        """Why it cannot take part here, or an empty string."""
        if self.module and importlib.util.find_spec(self.module) is None:
            return f"{self.module} is not installed ({_INSTALL})"
        return next(filter(None, (why() for why in self.needs)), "")


_ROS: Final = (why_no_ros,)
FIELD: Final[dict[str, Entry]] = {
    "floor_c": Entry(contenders.floor_c, needs=_ROS),  # compiled with the nodes' flags
    "floor_python": Entry(contenders.floor_python),
    "roscpp_nodelay": Entry(contenders.direct("roscpp", nodelay=True), needs=_ROS),
    "roscpp_nagle": Entry(contenders.direct("roscpp", nodelay=False), needs=_ROS),
    "rospy_nodelay": Entry(contenders.direct("rospy", nodelay=True), needs=_ROS),
    "rospy_nagle": Entry(contenders.direct("rospy", nodelay=False), needs=_ROS),
    "zenoh": Entry(zenoh(), "zenoh"),
    "zenoh_shm": Entry(zenoh("--shared-memory"), "zenoh"),
    "cyclonedds": Entry(cyclonedds, "cyclonedds"),
    "pyzmq": Entry(zeromq, "zmq"),
    "agents_hosts": Entry(contenders.agents_hosts, needs=(why_no_ros, why_no_hosts)),
    "agents_one_host": Entry(contenders.agents_one_host, needs=_ROS),
}


@dataclass(slots=True)
class Score:
    """One contender at one size, over all rounds.

    Args:
        trips: Round trips, ns.
        lost: Those that did not come back within a second.
        usage: By process.
    """

    trips: array[int] = field(default_factory=lambda: array("Q"))
    lost: int = 0
    usage: dict[str, Usage] = field(default_factory=dict)

    @property
    def one_way(self) -> samples.Summary:
        """Half of the round trips, µs."""
        return samples.summary([trip / 2000 for trip in self.trips], self.lost)


Scores = dict[tuple[str, int], Score]


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the tables, write the files; return the result."""
    plan = QUICK if quick else FULL
    host = HostLateness()
    scores: Scores = {}
    left_out: dict[str, str] = {}
    with Bed() as bed:
        taking_part = _start(bed, left_out, console)
        for turn in range(plan.rounds):
            console.print(f"round {turn + 1} of {plan.rounds}", style="dim")
            for size, trips in plan.trips.items():
                for one in [*taking_part[turn:], *taking_part[:turn]]:  # nobody is always behind the same neighbour
                    try:
                        _turn(one, size, trips // plan.rounds, bed.home / "samples", scores)
                    except Deadline as error:
                        left_out[one.key] = f"stopped answering at {tables.size(size)}"
                        console.print(f"left out from here on: {one.key}: {error}", style="red", markup=False)
                        taking_part.remove(one)
        titles = {one.key: one.title for one in taking_part}
    rows = _rows(scores, titles)
    for size in plan.trips:
        console.print(_table(size, scores, titles))
    small = min(plan.trips)
    usage = [(title, scores[key, small].usage, len(scores[key, small].trips)) for key, title in titles.items()]
    console.print(tables.usage_table(f"processes, {tables.size(small)}", usage, "round trip"))
    result: dict[str, object] = {"rows": rows, "left_out": left_out, **host.finish(console)}
    written = results.write("peers", asdict(plan), result, json)
    image = written.with_suffix(".png")
    plot.path(image, {key: [t / 2000 for t in one.trips] for key, one in scores.items()}, titles)
    console.print(f"written: {written} and {image.name}")
    return result


def _start(bed: Bed, left_out: dict[str, str], console: Console) -> list[Contender]:
    """Start all that can; say why the others cannot."""
    taking_part = []
    for key, entry in FIELD.items():
        reason = entry.why_not()
        if not reason:
            try:
                made = entry.start(bed)
            except Deadline as error:
                reason = f"did not start: {error}"
            else:
                for process in made.still:
                    process.freeze()
                taking_part.append(made)
                continue
        left_out[key] = reason
        console.print(f"left out: {key}: {reason}", style="yellow", markup=False)
    return taking_part


def _turn(one: Contender, size: int, trips: int, scratch: Path, scores: Scores) -> None:
    with one.awake():
        one.round(size, _WARM_UP, scratch)
        times, lost, usage = one.round(size, trips, scratch)
    score = scores.setdefault((one.key, size), Score())
    score.trips.extend(times)
    score.lost += lost
    score.usage = add(score.usage, usage)


def _median(scores: Scores, key: str, size: int) -> float | None:
    score = scores.get((key, size))
    return score.one_way.p50 if score else None


def _rows(scores: Scores, titles: dict[str, str]) -> list[dict[str, object]]:
    return [
        {
            "contender": key,
            "title": titles[key],
            "bytes": size,
            "one_way_us": asdict(score.one_way),
            "to_roscpp": tables.ratio(score.one_way.p50, _median(scores, _BASE, size)),
            "agents_to_it": tables.ratio(_median(scores, _OURS, size), score.one_way.p50),
            "processes": {name: tables.usage_row(usage, len(score.trips)) for name, usage in score.usage.items()},
        }
        for (key, size), score in scores.items()
        if key in titles
    ]


def _table(size: int, scores: Scores, titles: dict[str, str]) -> Table:
    table = Table(title=f"one way, {tables.size(size)}, µs")
    table.add_column("between the two nodes")
    for head in ("p50", "p95", "p99", "p99.9", "max", "trips", "lost", "to roscpp", "agents to it"):
        table.add_column(head, justify="right")
    for key, title in titles.items():
        row = scores[key, size].one_way
        cells = [tables.us(value) for value in (row.p50, row.p95, row.p99, row.p999, row.largest)]
        to_roscpp = tables.ratio(row.p50, _median(scores, _BASE, size))
        ours = tables.ratio(_median(scores, _OURS, size), row.p50)
        table.add_row(title, *cells, str(row.count), str(row.lost), tables.dash(to_roscpp), tables.dash(ours))
    return table
