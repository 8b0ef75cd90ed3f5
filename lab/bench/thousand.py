"""A thousand modules in one process: the real machines of every agent, on a simulated clock and network.

It shows how long all take to know all after a flash start, what an agent sends, receives and computes at rest, and
how soon changed offers and killed modules are known everywhere. ``tests.simulation`` plays it; of links only the
handshakes and sizes are simulated, so the bytes of links that something uses are not in the figures.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from lab.results import finish
from lab.tables import table_of

if TYPE_CHECKING:
    from rich.console import Console

_MODULES: Final = (100, 300, 1000)
_QUICK: Final = (100,)
_SEED: Final = 1
_ROOT: Final = Path(__file__).parents[2]


def measure(quick: bool, console: Console, json: Path | None = None) -> dict[str, object]:
    """Measure, print the table, write the file; return the result."""
    sizes = _QUICK if quick else _MODULES
    table = table_of(
        "a large mesh, simulated, 1 % packet loss (to reach: graphs 10 s, one killed 5 s, 5 KB/s, CPU 2 %)",
        ("modules",),
        (
            "members s",
            "graphs s",
            "start MB",
            "rest KB/s",
            "rest msg/s",
            "rest CPU %",
            "offers s",
            "one killed s",
            "a third, median s",
            "a third, all s",
            "false",
        ),
    )
    result: dict[str, object] = {}
    for size in sizes:
        figures = _play(size, console)
        result[f"{size} modules"] = figures
        worst = [seconds for seconds in figures["one_killed"] if seconds is not None]
        table.add_row(
            f"{size:,}",
            _text(figures["members_after"]),
            _text(figures["graphs_after"]),
            _text(figures["start_bytes"] / 1e6),
            _text(figures["rest_bytes"] / 1e3),
            _text(figures["rest_messages"]),
            _text(figures["rest_cpu_percent"]),
            _text(figures["changed_after"]),
            _text(max(worst, default=None)),
            _text(figures["killed_median"]),
            _text(figures["killed_all"]),
            str(figures["lost_falsely"]),
        )
    console.print(table)
    return finish(console, "thousand", {"seed": _SEED, "loss": 0.01}, result, json)


def _play(size: int, console: Console) -> dict[str, Any]:
    """One simulation, in a process of its own: its memory is gone before the next one begins."""
    with tempfile.TemporaryDirectory(prefix="rmpa-thousand-") as folder:
        file = Path(folder) / "figures.json"
        command = [sys.executable, "-m", "tests.simulation", "--kind", "thousand", "--seed", str(_SEED)]
        console.print(f"{size:,} modules ...")
        subprocess.run([*command, "--peers", str(size), "--json", str(file)], cwd=_ROOT, check=True)
        figures: dict[str, Any] = msgspec.json.decode(file.read_bytes())
    return figures


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}" if value < 10 else f"{value:,.0f}"
