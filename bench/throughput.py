"""How much goes through: a roscpp node that publishes as fast as it can, a roscpp node that counts."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from rich.table import Table

from bench import results
from bench.bed import NODES, Bed
from bench.usage import Meter, Usage

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from tests.interop.processes import Process
    from tests.interop.ros import Ros

_SIZES: Final = (64, 1024 * 1024)
_QUEUE: Final = {64: 10_000, 1024 * 1024: 50}


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the table, write the file; return the result."""
    span = 2.0 if quick else 5.0
    table = Table(title="throughput: published as fast as roscpp can, counted at the far node")
    table.add_column("path")
    for head in ("bytes", "messages/s", "MB/s", "sent/s", "CPU, % of a core"):
        table.add_column(head, justify="right")
    rows: list[dict[str, object]] = []
    for size in _SIZES:
        for title, run in (("roscpp direct", _direct), ("two agents, two hosts", _agents)):
            row = {"path": title, **run(size, span)}
            rows.append(row)
            cells = [f"{row['messages_per_s']:.0f}", f"{row['mb_per_s']:.1f}", f"{row['sent_per_s']:.0f}"]
            table.add_row(title, str(size), *cells, str(row["cpu_percent"]))
    console.print(table)
    result: dict[str, object] = {"rows": rows}
    console.print(f"written: {results.write('throughput', {'seconds': span}, result, json)}")
    return result


def _direct(size: int, span: float) -> dict[str, object]:
    with Bed() as bed:
        shell = bed.shell()
        shell.master()
        return _run(shell, shell, size, span, {})


def _agents(size: int, span: float) -> dict[str, object]:
    with Bed() as bed:
        a, b = bed.lab.hosts("a", "b")
        agents = {host.name: bed.agent(host, name=host.name).process for host in (a, b)}
        return _run(bed.shell(a), bed.shell(b), size, span, agents)


def _run(here: Ros, there: Ros, size: int, span: float, agents: dict[str, Process]) -> dict[str, object]:
    sink = there.roscpp("sink", nodes=NODES, nodelay=True, queue=_QUEUE[size])
    flood = here.roscpp("flood", nodes=NODES, size=size, queue=_QUEUE[size])
    sink.wait_event("window", where=lambda event: _number(event, "count") > 0)
    time.sleep(1.0)
    meter = Meter({"flood": flood.pid, **{name: one.pid for name, one in agents.items()}, "sink": sink.pid})
    first = sink.wait_event("window", since=sink.mark_events())
    sent = flood.wait_event("sent", since=flood.mark_events())
    time.sleep(span)
    last = sink.wait_event("window", since=sink.mark_events())
    sent_last = flood.wait_event("sent", since=flood.mark_events())
    usage: dict[str, Usage] = meter.read()
    seconds = (_number(last, "ns") - _number(first, "ns")) / 1e9
    return {
        "bytes": size,
        "messages_per_s": (_number(last, "count") - _number(first, "count")) / seconds,
        "mb_per_s": (_number(last, "bytes") - _number(first, "bytes")) / seconds / 1e6,
        "sent_per_s": (_number(sent_last, "count") - _number(sent, "count")) / seconds,
        "cpu_percent": {name: round(one.percent) for name, one in usage.items()},
        "rss_mb": {name: round(one.rss / 1e6, 1) for name, one in usage.items()},
    }


def _number(event: dict[str, object], key: str) -> int:
    return int(str(event[key]))
