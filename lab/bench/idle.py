"""What an agent costs while nothing happens: processor time and memory, alone with one peer and with four."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Final

from lab.bed.bench import Bed
from lab.results import finish
from lab.tables import table_of
from lab.usage import Meter

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

# Seconds after the last link: the burst of beacons and the first exchange are over.
_SETTLE: Final = 4.0


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the table, write the file; return the result."""
    span = 5.0 if quick else 20.0
    table = table_of(
        f"an idle agent over {span:.0f} s (to reach: 1 % of a core, 45 MB)",
        (),
        ("peers", "CPU mean, %", "CPU worst agent, %", "RSS worst agent, MB"),
    )
    result: dict[str, object] = {}
    for peers in (1, 4):
        cpu, rss = _agents(peers + 1, span)
        table.add_row(str(peers), f"{sum(cpu) / len(cpu):.2f}", f"{max(cpu):.2f}", f"{max(rss):.1f}")
        result[f"{peers} peers"] = {"cpu_percent": cpu, "rss_mb": rss}
    console.print(table)
    return finish(console, "idle", {"seconds": span}, result, json)


def _agents(count: int, span: float) -> tuple[list[float], list[float]]:
    with Bed() as bed:
        names = [f"m{number}" for number in range(count)]
        agents = [bed.agent(host, name=host.name) for host in bed.lab.hosts(*names)]
        for other in names[1:]:
            agents[0].wait_peer(other)
        time.sleep(_SETTLE)
        meter = Meter({agent.name: agent.pid for agent in agents})
        time.sleep(span)
        usage = meter.read().values()
    return [round(one.percent, 3) for one in usage], [round(one.rss / 1e6, 1) for one in usage]
