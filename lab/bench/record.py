"""What recording costs: the flight recorder beside ``rosbag record`` on the same topics, in turns."""

from __future__ import annotations

import signal
import statistics
import time
from typing import TYPE_CHECKING, Final

import psutil

from lab.bed.agents import RMPA
from lab.bed.bench import TEST_NODES, Bed
from lab.bed.processes import Process
from lab.results import finish
from lab.tables import table_of
from lab.usage import Meter

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from lab.bed.agents import Agent
    from lab.bed.ros import Ros

# By a part of the measurement: topics with their rates and sizes.
_LOADS: Final = {
    "nothing": (),
    "500 messages/s of 100 B": tuple((f"/small{n}", 100.0, 100) for n in range(5)),
    "30 MB/s of images": (("/image", 32.5, 921_600),),
    "both": (*((f"/small{n}", 100.0, 100) for n in range(5)), ("/image", 32.5, 921_600)),
}
_SETTLE: Final = 4.0
# Without the budgets of topics, so that both recorders write the same.
_CONFIG: Final = '[record]\ntopic_rate = "unlimited"\nthin = "unlimited"\nmegabytes = 4000\n'


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the table, write the file; return the result."""
    span, rounds = (5.0, 1) if quick else (20.0, 3)
    columns = ("load", "recorder", "CPU, % of a core", "written, MB/s", "messages")
    table = table_of(f"recorders over {span:.0f} s, medians of {rounds} rounds in turns", (), columns)
    result: dict[str, object] = {}
    for load, topics in _LOADS.items():
        found: dict[str, list[tuple[float, float, int]]] = {"rmpa record": [], "rosbag record -a": []}
        for _ in range(rounds):
            for kind, values in found.items():
                values.append(_round(kind, topics, span))
        for kind, values in found.items():
            cpu, written, count = (statistics.median(column) for column in zip(*values, strict=True))
            table.add_row(load, kind, f"{cpu:.2f}", f"{written:.2f}", f"{count:.0f}")
            result[f"{load}: {kind}"] = {"cpu_percent": cpu, "mb_a_second": written, "messages": count}
    console.print(table)
    return finish(console, "record", {"seconds": span, "rounds": rounds}, result, json)


def _round(kind: str, topics: tuple[tuple[str, float, int], ...], span: float) -> tuple[float, float, int]:
    """CPU in percent, MB a second on the disk, and messages of one recorder."""
    with Bed() as bed:
        agent = bed.agent(bed.lab.hosts("robot")[0], name="robot", config=_CONFIG)
        shell = bed.shell(agent.host, agent.core_port)
        shell.nodes = TEST_NODES  # type: ignore[misc] # of this shell alone
        folder = bed.home / "recorded"
        folder.mkdir()
        for topic, rate, size in topics:
            shell.roscpp("talker", topic=topic, rate=rate, size=size, name=topic[1:]).wait_event("up")
        recorder = _start(kind, agent, shell, folder)
        try:
            time.sleep(_SETTLE)
            before, meter = _bytes(bed.home), Meter(_processes(recorder.pid))
            time.sleep(span)
            usage, after = meter.read().values(), _bytes(bed.home)
        finally:
            recorder.send(signal.SIGINT)
            recorder.wait()
        return (
            sum(one.percent for one in usage),
            (after - before) / span / 1e6,
            round(span * sum(rate for _, rate, _ in topics)),
        )


def _start(kind: str, agent: Agent, shell: Ros, folder: Path) -> Process:
    if kind == "rmpa record":
        argv = [str(RMPA), "record", "--agent", agent.name, "--config", str(agent.home / f"{agent.name}.toml")]
        return Process(agent.host.command(argv), env=agent.env, name="rmpa record")
    return shell.start("rosbag", "record", "-a", "-b", "0", "-O", str(folder / "all.bag"))


def _processes(pid: int) -> dict[str, int]:
    """A program and what it has started: rosbag is a script that starts another program."""
    return {str(one.pid): one.pid for one in (psutil.Process(pid), *psutil.Process(pid).children(recursive=True))}


def _bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
