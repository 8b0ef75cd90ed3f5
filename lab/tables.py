"""What the tables of the measurements share: numbers as text, processes on a path, and what was to be reached."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from rich.table import Table

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from rich.console import Console

    from lab.usage import Usage


@dataclass(frozen=True, slots=True)
class Target:
    """A figure of the project's own that a measurement is held against.

    Args:
        what: The figure, in words.
        value: What came out; ``None`` if the samples were too few to say.
        limit: What it may be at the most, or at the least.
        at_least: Which of the two.
    """

    what: str
    value: float | None
    limit: float
    at_least: bool = False

    @property
    def reached(self) -> bool | None:
        """Whether it was reached; ``None`` if nobody knows."""
        if self.value is None:
            return None
        return self.value >= self.limit if self.at_least else self.value <= self.limit


def show_targets(console: Console, targets: Sequence[Target]) -> list[dict[str, object]]:
    """Print each with its verdict; return them for the result."""
    for target in targets:
        word = {True: "reached", False: "not reached", None: "too few samples to say"}[target.reached]
        style = {True: "green", False: "red", None: "yellow"}[target.reached]
        sign = "≥" if target.at_least else "≤"
        console.print(f"{target.what}: {dash(target.value)} (to reach: {sign} {target.limit:g}): {word}", style=style)
    return [{**asdict(target), "reached": target.reached} for target in targets]


def ratio(value: float | None, base: float | None) -> float | None:
    """``value`` as a multiple of ``base``, where there are both."""
    return round(value / base, 3) if value is not None and base else None


def us(value: float | None) -> str:
    """Microseconds."""
    return "-" if value is None else f"{value:.1f}" if value < 1000 else f"{value:.0f}"


def dash(value: float | None) -> str:
    """A ratio or a share."""
    return "-" if value is None else f"{value:.2f}"


def size(count: int) -> str:
    """Bytes."""
    for unit, name in ((1024 * 1024, "MB"), (1024, "KB")):
        if count >= unit:
            return f"{count // unit} {name}"
    return f"{count} B"


def usage_row(usage: Usage, messages: int) -> dict[str, float]:
    """One process over a span with so many messages (or round trips), for the result."""
    return {
        "cpu_percent": round(usage.percent, 1),
        "cpu_us_per_message": round(1e6 * usage.cpu / messages, 1) if messages else 0.0,
        "rss_mb": round(usage.rss / 1e6, 1),
    }


def usage_table(title: str, rows: Iterable[tuple[str, Mapping[str, Usage], int]], unit: str = "message") -> Table:
    """The processes of each path; a row is the path's title, its processes' usage, and the messages in that span."""
    table = Table(title=title)
    for head in ("path", "process"):
        table.add_column(head)
    for head in (f"µs of CPU a {unit}", "% of a core", "RSS, MB"):
        table.add_column(head, justify="right")
    for path, processes, messages in rows:
        first = path  # named once for its block
        for name, usage in processes.items():
            row = usage_row(usage, messages)
            cells = [str(row[key]) for key in ("cpu_us_per_message", "cpu_percent", "rss_mb")]
            table.add_row(first, name, *cells)
            first = ""
    return table
