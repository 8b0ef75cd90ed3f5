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
from lab.bed.transport import require
from lab.findings import Claim
from lab.results import finish
from lab.tables import table_of

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console

    from lab.bed.plan import Transport

_TARGET: Final = 0.5
# Seconds that the first message may come later where the route is direct.
_LATER: Final = 0.010
_TRANSPORTS: Final[dict[Transport, str]] = {"relay": "", "direct": ", RMPA direct"}
# Seconds that the waiting nodes get to come up before the second agent starts.
_SETTLE: Final = 1.5


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure both directions by both transports, print the table, write the file; return the result."""
    runs = 3 if quick else 15
    rows: dict[str, dict[str, list[float]]] = {}
    claims = []
    for direction in ("publisher starts last", "subscriber starts last"):
        for _ in range(runs):
            for transport, suffix in _TRANSPORTS.items():
                message, ready = _once(transport, publisher_last=direction.startswith("publisher"))
                row = rows.setdefault(direction + suffix, {"message": [], "ready": []})
                row["message"].append(message)
                row["ready"].append(ready)
        relayed, straight = (statistics.median(rows[direction + of]["message"]) for of in _TRANSPORTS.values())
        claims.append(Claim(f"first message, {direction}", relayed, _TARGET, unit="s"))
        text = f"first message, {direction}: RMPA direct later than relayed"
        claims.append(Claim(text, round(straight - relayed, 4), _LATER, unit="s"))
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
    return finish(console, "startup", {"runs": runs}, result, json, claims=claims)


def _once(transport: Transport, *, publisher_last: bool) -> tuple[float, float]:
    """Seconds to the first message, and to READY=1."""
    with Bed() as bed:
        a, b = bed.lab.hosts("a", "b")
        bed.agent(a, name="a", way=transport)
        second = bed.agent(b, name="b", start=False, way=transport)
        talking, hearing = (b, a) if publisher_last else (a, b)
        listener = bed.shell(hearing).roscpp("listener", nodes=TEST_NODES, topic="/chatter", nodelay=True)
        talker = bed.shell(talking).roscpp("talker", nodes=TEST_NODES, topic="/chatter", rate=200)
        time.sleep(_SETTLE)
        begun = time.time_ns()
        second.start()
        first = listener.wait_event("first")
        second.wait_ready()
        require(transport, [(talker, listener)])
        return (int(str(first["stamp_ns"])) - begun) / 1e9, second.ready_after
