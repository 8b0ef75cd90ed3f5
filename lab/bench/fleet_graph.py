"""What the graph of 999 peers costs one agent; ``fleet_graph_agent`` says what is measured."""

from __future__ import annotations

import json as jsons
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

from lab.bench.fleet_graph_agent import AT_REST, NODES, GraphCost
from lab.findings import Claim
from lab.results import finish
from lab.tables import table_of

if TYPE_CHECKING:
    from rich.console import Console

_RSS_LIMIT: Final = 120.0
_REST_LIMIT: Final = 2.0


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the table, write the file; return the result."""
    steps = ((100, 20), (300, 20)) if quick else ((100, 20), (300, 20), (999, 20))
    rows = [_apart(*step) for step in steps]
    heads = ["peers", "topics of each", "CPU to take in, s", "longest hold, ms", "RSS, MB", "B a topic"]
    heads += ["compare, ms", "at rest, %", "a third leaves, s"]
    table = table_of("the graph of many peers in one agent", (), heads)
    for row in rows:
        cells = [str(row.peers), str(row.topics), f"{row.seconds:.2f}", f"{row.hold_ms:.1f}", f"{row.rss_mb:.1f}"]
        cells += [f"{row.bytes_per_topic:.0f}", f"{row.compare_ms:.0f}", f"{row.rest_percent:.2f}"]
        table.add_row(*cells, f"{row.removed_seconds:.2f}")
    console.print(table)
    most = rows[-1]
    claims = [
        Claim(f"{most.peers} peers with {most.topics} topics: RSS, MB", most.rss_mb, _RSS_LIMIT),
        Claim(f"{most.peers} peers: at rest, % of a core", most.rest_percent, _REST_LIMIT),
    ]
    result: dict[str, object] = {"rows": [asdict(row) for row in rows]}
    return finish(console, "fleet_graph", {"nodes": NODES, "rest": AT_REST}, result, json, claims=claims)


def _apart(peers: int, topics: int) -> GraphCost:
    """Measure in a process of its own, so that memory is that of one agent."""
    words = [sys.executable, "-m", "lab.bench.fleet_graph_agent", str(peers), str(topics)]
    told = subprocess.run(words, check=True, capture_output=True, text=True, cwd=Path(__file__).parents[2]).stdout
    return GraphCost(**jsons.loads(told.splitlines()[-1]))
