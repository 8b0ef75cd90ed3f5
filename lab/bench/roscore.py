"""What it costs to follow the graph of a real roscore (``--core external``), and how soon a change of it is seen.

The external core alone, in this process and in the agent's own loop, beside Debian's rosmaster.
"""

from __future__ import annotations

import asyncio
import os
import socket
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Final

import psutil

from lab.bed.bench import Bed
from lab.findings import Claim
from lab.results import finish
from lab.tables import table_of
from lab.usage import Meter
from rmpa.ros.core.external import ExternalCore
from rmpa.ros.http.rpc import call
from rmpa.ros.master.mirror import one_call
from rmpa.runtime.loop import AgentLoop

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from lab.bed.processes import Process
    from rmpa.ros.wire.xmlrpc import XmlRpcValue

GRAPHS: Final = ((10, 50, 20), (50, 500, 100), (200, 4000, 800))
"""Nodes, topics with a publisher and a subscriber each, services."""
_TYPICAL: Final = 500
"""Topics of a large robot; what is to be reached holds up to these."""
_AT_ONCE: Final = 100
"""Registrations in one call."""
_SETTLE: Final = 3.0
"""Seconds until the looks are as seldom as they get, and rosmaster has given up telling nodes that do not answer."""


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the table, write the file; return the result."""
    span, changes = (5.0, 5) if quick else (20.0, 40)
    table = table_of(
        f"following a roscore over {span:.0f} s, and {changes} changes of its graph",
        (),
        (
            "nodes",
            "topics",
            "services",
            "agent, % of a core",
            "rosmaster, %",
            "seen after p50, s",
            "worst, s",
        ),
    )
    rows: dict[str, dict[str, object]] = {}
    worst = 0.0
    for graph in GRAPHS:
        with Bed() as bed, asyncio.Runner(loop_factory=AgentLoop) as runner:
            ros = bed.shell()
            row = runner.run(_follow(ros.uri, ros.master(), graph, span, changes))
        delays = sorted(row.pop("delays"))
        if graph[1] <= _TYPICAL:
            worst = max(worst, delays[-1])
        p50 = delays[len(delays) // 2]
        table.add_row(
            *map(str, graph), f"{row['agent'][0]:.2f}", f"{row['master'][0]:.2f}", f"{p50:.2f}", f"{delays[-1]:.2f}"
        )
        name = "{} nodes, {} topics, {} services".format(*graph)
        rows[name] = {
            "agent_percent": row["agent"][0],
            "rosmaster_percent": row["master"][0],
            "delays_s": [round(delay, 3) for delay in delays],
        }
    console.print(table)
    targets = [Claim(f"with {_TYPICAL} topics a change is seen after, s, worst", worst, 1.0)]
    result: dict[str, object] = {"graphs": rows}
    return finish(console, "roscore", {"seconds": span, "changes": changes}, result, json, claims=targets)


async def _follow(
    uri: str, master: Process, graph: tuple[int, int, int], span: float, changes: int
) -> dict[str, list[float]]:
    """Processor time of both over a span without a change, in percent, and the seconds until each change was seen."""
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(graph[0])]
        calls = list(_graph(graph, [f"http://127.0.0.1:{one.getsockname()[1]}/" for one in sockets]))
        for begin in range(0, len(calls), _AT_ONCE):
            await call(uri, "system.multicall", calls[begin : begin + _AT_ONCE], timeout=30.0)
        core = ExternalCore(uri, own_node="/rmpa")
        await core.start()
        await asyncio.sleep(_SETTLE)
        meter, before = Meter({"agent": os.getpid()}), _ticks(master.pid)
        await asyncio.sleep(span)
        usage = meter.read()["agent"]
        asked = 100 * (_ticks(master.pid) - before) / usage.wall
        delays = [await _seen(uri, core, number) for number in range(changes)]
        await core.close()
    return {"agent": [usage.percent], "master": [asked], "delays": delays}


def _ticks(pid: int) -> float:
    """Processor seconds in ticks of 10 ms, those of threads that have ended included: rosmaster makes one a call."""
    times = psutil.Process(pid).cpu_times()
    return times.user + times.system


def _graph(graph: tuple[int, int, int], apis: list[str]) -> list[XmlRpcValue]:
    nodes, topics, services = graph
    calls = []
    for number in range(topics):
        for method, node in (("registerPublisher", number % nodes), ("registerSubscriber", (number + 1) % nodes)):
            topic = f"/ns/some/topic_{number}"
            calls.append(one_call(method, [f"/ns/node_{node}", topic, "sensor_msgs/Image", apis[node]]))
    for number in range(services):
        node = number % nodes
        params = [f"/ns/node_{node}", f"/ns/service_{number}", "rosrpc://127.0.0.1:1", apis[node]]
        calls.append(one_call("registerService", params))
    return calls


async def _seen(uri: str, core: ExternalCore, number: int) -> float:
    """Register something at the master, at any moment between two looks; how long it took to be seen."""
    await asyncio.sleep(1.5 + 0.13 * (number % 8))
    topic, seen = f"/fresh_{number}", asyncio.Event()
    core.on_change(lambda change: seen.set() if change.name == topic else None)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        api = f"http://127.0.0.1:{listening.getsockname()[1]}/"
        begin = time.perf_counter()
        await call(uri, "registerPublisher", f"/fresh_node_{number}", topic, "std_msgs/String", api)
        if not core.publishers(topic):
            await seen.wait()
        return time.perf_counter() - begin
