"""How much later the first message of a parked peer arrives: its link has to be made first.

Two agents on loopback and a latched topic. A node subscribes while the link is parked, and once more while it stands.
"""

from __future__ import annotations

import asyncio
import statistics
import time
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Final

from lab import samples
from lab.bed.bench import Bed
from lab.bed.processes import eventually
from lab.results import finish
from lab.tables import table_of
from rmpa.ros.node.node import Node

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from lab.bed.agents import Agent

_CONFIG: Final = '[mesh]\nlinks = "demand"\n'
_PATIENCE: Final = 120.0
"""Seconds in which a link is parked that nothing needs; the protocol takes 20 to 25."""


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the table, write the file; return the result."""
    runs = 3 if quick else 20
    with Bed() as bed:
        a, b = (bed.agent(name=name, config=_CONFIG) for name in ("a", "b"))
        rows = asyncio.run(_measure(a, b, runs))
    linked, parked = (statistics.median(row) for row in rows.values())
    table = table_of("from subscribing to the first message, ms", ("link",), ("median", "best", "worst", "runs"))
    for name, row in rows.items():
        values = (statistics.median(row), min(row), max(row))
        table.add_row(name, *[f"{1e3 * value:.1f}" for value in values], str(runs))
    console.print(table)
    console.print(f"parked: {parked / linked:.2f} times as late")
    result: dict[str, object] = {
        name: {"seconds": row, "summary": asdict(samples.summary(row))} for name, row in rows.items()
    }
    return finish(console, "parked", {"runs": runs}, result, json)


async def _measure(a: Agent, b: Agent, runs: int) -> dict[str, list[float]]:
    """The seconds of each run, with a link that stands and with a parked one."""
    rows: dict[str, list[float]] = {"stands": [], "parked": []}
    async with (
        Node("talker", master_uri=f"http://127.0.0.1:{a.core_port}") as talker,
        Node("listener", master_uri=f"http://127.0.0.1:{b.core_port}") as listener,
    ):
        publisher = await talker.advertise("/map", "std_msgs/String", latch=True)
        publisher.publish(publisher.make({"data": "map"}))
        await asyncio.to_thread(b.wait_peer, "a")
        await _first_message(listener)
        for _ in range(runs):
            await asyncio.to_thread(eventually, partial(_parked, b), _PATIENCE, what="the link is parked", every=0.5)
            rows["parked"].append(await _first_message(listener))
            rows["stands"].append(await _first_message(listener))
    return rows


async def _first_message(node: Node) -> float:
    """Seconds from subscribing to the first message."""
    begun = time.perf_counter()
    subscriber = await node.subscribe("/map", "std_msgs/String")
    try:
        async with asyncio.timeout(_PATIENCE):
            async for _ in subscriber:
                break
        return time.perf_counter() - begun
    finally:
        await subscriber.close()


def _parked(agent: Agent) -> bool:
    return [peer.state for peer in agent.snapshot().peers] == ["parked"]
