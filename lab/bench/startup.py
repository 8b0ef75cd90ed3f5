"""How long until a message arrives: from the exec of the second agent to the far node's first callback.

Nodes on both sides are unmodified roscpp nodes that already run and wait for their master, as after power-on.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Final

from lab import samples
from lab.bed.bench import TEST_NODES, Bed
from lab.results import finish
from lab.tables import table_of

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

_TARGET: Final = 0.5
_SETTLE: Final = 1.5
"""Seconds that the waiting nodes get to come up before the second agent starts."""


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure both directions, print the table, write the file; return the result."""
    runs = 3 if quick else 10
    rows: dict[str, dict[str, list[float]]] = {}
    for direction in ("publisher starts last", "subscriber starts last"):
        rows[direction] = {"message": [], "ready": []}
        for _ in range(runs):
            message, ready = _once(publisher_last=direction.startswith("publisher"))
            rows[direction]["message"].append(message)
            rows[direction]["ready"].append(ready)
    table = table_of(
        f"from exec of the second agent, s (to reach: {_TARGET} to the first message)",
        ("case",),
        ("ready, median", "first message, median", "best", "worst", "runs"),
    )
    for direction, row in rows.items():
        values = [statistics.median(row["ready"]), statistics.median(row["message"]), min(row["message"])]
        table.add_row(direction, *[f"{value:.3f}" for value in [*values, max(row["message"])]], str(runs))
    console.print(table)
    result: dict[str, object] = {
        direction: {"seconds": row, "summary": asdict(samples.summary(row["message"]))}
        for direction, row in rows.items()
    }
    return finish(console, "startup", {"runs": runs}, result, json)


def _once(*, publisher_last: bool) -> tuple[float, float]:
    """Seconds to the first message, and to READY=1."""
    with Bed() as bed:
        a, b = bed.lab.hosts("a", "b")
        bed.agent(a, name="a")
        second = bed.agent(b, name="b", start=False)
        talking, hearing = (b, a) if publisher_last else (a, b)
        listener = bed.shell(hearing).roscpp("listener", nodes=TEST_NODES, topic="/chatter", nodelay=True)
        bed.shell(talking).roscpp("talker", nodes=TEST_NODES, topic="/chatter", rate=200)
        time.sleep(_SETTLE)
        begun = time.time_ns()
        second.start()
        first = listener.wait_event("first")
        second.wait_ready()
        return (int(str(first["stamp_ns"])) - begun) / 1e9, second.ready_after
