"""What recording costs: the flight recorder beside ``rosbag record`` on the same topics, in turns.

Images have noise in their low bits, as a camera's: zstd leaves 58 % of them. At last a command is relayed to another
module while both recorders, or none, record these topics and the command itself.
"""

from __future__ import annotations

import shutil
import signal
import statistics
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import psutil

from lab.bed.agents import RMPA
from lab.bed.bench import TEST_NODES, Bed
from lab.bed.processes import Process
from lab.bench import schedule
from lab.findings import Claim
from lab.results import finish
from lab.tables import dash, table_of
from lab.usage import Meter

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from rich.console import Console

    from lab.bed.ros import Ros

Topics = tuple[tuple[str, float, int], ...]
_SMALL: Final[Topics] = tuple((f"/small{n}", 100.0, 100) for n in range(5))
_IMAGES: Final[Topics] = (("/image", 32.5, 921_600),)
_NOTHING, _BOTH = "nothing", "both"
# By a part of the measurement: topics with their rates and sizes.
_LOADS: Final[dict[str, Topics]] = {
    _NOTHING: (),
    "500 messages/s of 100 B": _SMALL,
    "30 MB/s of images": _IMAGES,
    _BOTH: _SMALL + _IMAGES,
}
_NONE, _RMPA, _ROSBAG = "none", "rmpa record", "rosbag record -a"
_SETTLE: Final = 3.0
_COMMAND_BYTES: Final = 64
_COMMAND_HZ: Final = 200.0
# Without the budgets of topics, so that both recorders write the same.
_PAIR: Final = schedule.AgentPair(
    "agents", "two agents", "relay", '[record]\ntopic_rate = "unlimited"\nthin = "unlimited"\nmegabytes = 1000\n'
)


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the tables, write the file; return the result."""
    span, rounds = (3.0, 1) if quick else (5.0, 3)  # what a recorder does at rest it does every 5 s
    result: dict[str, object] = {}
    columns = ("load", "recorder", "CPU, % of a core", "written, MB/s", "messages")
    table = table_of(f"recorders over {span:.0f} s, medians of {rounds} rounds in turns", (), columns)
    with Bed() as bed:
        way = schedule.agents(bed, _PAIR)
        shell = bed.shell(way.agents[0].host, way.agents[0].core_port)
        shell.nodes = TEST_NODES  # type: ignore[misc] # of this shell alone
        cpu_of: dict[tuple[str, str], float] = {}
        for load, topics in _LOADS.items():
            found: dict[str, list[tuple[float, float]]] = {_RMPA: [], _ROSBAG: []}
            with _talking(shell, topics):
                for _ in range(rounds):
                    for kind, values in found.items():
                        values.append(_round(kind, bed, way, span))
            count = round(span * sum(rate for _, rate, _ in topics))
            for kind, values in found.items():
                cpu, written = (statistics.median(column) for column in zip(*values, strict=True))
                cpu_of[load, kind] = cpu
                table.add_row(load, kind, f"{cpu:.2f}", f"{written:.2f}", f"{count}")
                result[f"{load}: {kind}"] = {"cpu_percent": cpu, "mb_a_second": written, "messages": count}
        console.print(table)
        scores = _relayed(bed, way, shell, span, rounds)
    late = table_of(f"a command of {_COMMAND_BYTES} B at {_COMMAND_HZ:.0f} Hz beside both, ms", (), _LATE)
    base = scores[_NONE].median_of_rounds(99)
    for kind, score in scores.items():
        p99, found_of = score.median_of_rounds(99), score.summary
        times = (found_of.p50, p99, found_of.largest)
        factor = p99 / base if p99 and base else None
        late.add_row(kind, *(dash(value and value / 1000) for value in times), dash(factor), str(score.lost))
        result[f"relayed beside {kind}"] = {"p99_of_rounds_us": p99, "times_of_none": factor, **score.row(_DEADLINE)}
    console.print(late)
    ours = scores[_RMPA].median_of_rounds(99)
    claims = [
        Claim("CPU of rmpa record while nothing happens, % of a core", cpu_of[_NOTHING, _RMPA], 0.3),
        Claim("CPU of rmpa record beside both, % of a core", cpu_of[_BOTH, _RMPA], 15.0),
        Claim("p99 of a relayed command beside rmpa record, times of none", ours and base and ours / base, 1.1),
    ]
    return finish(console, "record", {"seconds": span, "rounds": rounds}, result, json, claims=claims)


_LATE: Final = ("recorder", "p50", "p99, median of rounds", "max", "times of none", "never came")
# µs.
_DEADLINE: Final = 10_000.0


@contextmanager
def _talking(shell: Ros, topics: Topics) -> Iterator[None]:
    """Publish topics meanwhile."""
    talkers = [
        shell.roscpp("talker", topic=topic, rate=rate, size=size, name=topic[1:], noise=True)
        for topic, rate, size in topics
    ]
    for talker in talkers:
        talker.wait_event("up")
    yield
    for talker in talkers:
        talker.end()


@contextmanager
def _recording(kind: str, bed: Bed, way: schedule.Way) -> Iterator[Process | None]:
    """Let a recorder of the first module run meanwhile; what it wrote is gone then."""
    agent, folder = way.agents[0], bed.home / "recorded"
    folder.mkdir()
    recorder = None
    if kind == _RMPA:
        argv = [str(RMPA), "record", "--agent", agent.name, "--config", str(agent.home / f"{agent.name}.toml")]
        recorder = Process(agent.host.command(argv), env=agent.env, name=kind)
    elif kind == _ROSBAG:
        recorder = way.here.start("rosbag", "record", "-a", "-b", "0", "-O", str(folder / "all.bag"))
    try:
        time.sleep(_SETTLE)
        yield recorder
    finally:
        if recorder is not None:
            recorder.send(signal.SIGINT)
            recorder.wait()
        shutil.rmtree(folder)
        for ring in bed.home.rglob("record/ring"):
            shutil.rmtree(ring)


def _round(kind: str, bed: Bed, way: schedule.Way, span: float) -> tuple[float, float]:
    """CPU in percent, and MB a second on the disk, of one recorder."""
    with _recording(kind, bed, way) as recorder:
        assert recorder is not None
        before, meter = _bytes(bed.home), Meter(_processes(recorder.pid))
        time.sleep(span)
        usage, after = meter.read().values(), _bytes(bed.home)
    return sum(one.percent for one in usage), (after - before) / span / 1e6


def _relayed(bed: Bed, way: schedule.Way, shell: Ros, span: float, rounds: int) -> dict[str, schedule.LatencyScore]:
    """The latencies of a command to the other module, by the recorder that runs beside it."""
    scores = {kind: schedule.LatencyScore() for kind in (_NONE, _RMPA, _ROSBAG)}
    stream = way.stream(bed, "/command")
    with _talking(shell, _LOADS[_BOTH]):
        for _ in range(rounds):
            for kind, score in scores.items():
                with _recording(kind, bed, way):
                    score.add(stream.run(_COMMAND_BYTES, _COMMAND_HZ, span))
    return scores


def _processes(pid: int) -> dict[str, int]:
    """A program and what it has started: rosbag is a script that starts another program."""
    return {str(one.pid): one.pid for one in (psutil.Process(pid), *psutil.Process(pid).children(recursive=True))}


def _bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
