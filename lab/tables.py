"""Tables of the measurements on the terminal: numbers as text, percentiles, processes on a path."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.table import Table

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from lab.samples import Summary
    from lab.usage import Usage


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


def table_of(title: str, left: Sequence[str], right: Sequence[str]) -> Table:
    """An empty table with columns of words (``left``) and of figures (``right``)."""
    made = Table(title=title)
    for head in left:
        made.add_column(head)
    for head in right:
        made.add_column(head, justify="right")
    return made


def percentiles(found: Summary) -> list[str]:
    """The cells p50, p95, p99, p99.9 and max, in µs."""
    return [us(value) for value in (found.p50, found.p95, found.p99, found.p999, found.largest)]


def usage_table(title: str, rows: Iterable[tuple[str, Mapping[str, Usage], int]], unit: str = "message") -> Table:
    """The processes of each path; a row is the path's title, its processes' usage, and the messages in that span."""
    made = table_of(title, ("path", "process"), (f"µs of CPU a {unit}", "% of a core", "RSS, MB"))
    for path, processes, messages in rows:
        first = path  # named once for its block
        for name, usage in processes.items():
            row = usage_row(usage, messages)
            cells = [str(row[key]) for key in ("cpu_us_per_message", "cpu_percent", "rss_mb")]
            made.add_row(first, name, *cells)
            first = ""
    return made
