"""``rmpa web`` beside foxglove-sdk's server: messages, slow clients, pages.

The servers stand beside each other on this machine and take turns; each has a publisher of its own.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Final

from lab import tables
from lab.bed.bench import Bed
from lab.bed.processes import BedError
from lab.findings import Claim
from lab.results import finish
from lab.tables import dash, ratio, table_of
from lab.web import page
from lab.web.messages import Load, Way, stall
from lab.web.servers import WebServer, start_rmpa, start_sdk, why_no_sdk

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from rich.console import Console


# What ``--only`` can choose.
PARTS: Final = ("messages", "slow", "page")
_MIB: Final = 1 << 20
_CLIENTS: Final = 4
_SDK_TARGET: Final = 1.5
# Megabytes of 2^20 bytes.
_SLOW_TARGET: Final = 16.0
# Percent of a core.
_PAGE_TARGET: Final = 5.0
_FRAMES_TARGET: Final = 30.0
_PAINT_TARGET: Final = 1000.0
# KB of 1,000 bytes.
_BYTES_TARGET: Final = 250.0
_MODULES: Final = 16
_SLOW_WAYS: Final = ("rmpa cbor-raw", "rmpa foxglove", "sdk foxglove")


@dataclass(frozen=True, slots=True)
class WebPlan:
    """How much is measured.

    Args:
        rounds: Turns of each way.
        load: To four clients.
        slow: Beside a client that does not read.
        seconds: That one page is served, and half of them in a browser.
        loads: Of the page.
    """

    rounds: int
    load: Load
    slow: Load
    seconds: float
    loads: int


FULL: Final = WebPlan(5, Load(_MIB, 20.0, 100), Load(_MIB, 10.0, 100), 20.0, 5)
QUICK: Final = WebPlan(1, Load(_MIB, 20.0, 20), Load(_MIB, 10.0, 40), 6.0, 2)


@dataclass
class _Run:
    """One run, and what has come out of it."""

    bed: Bed
    plan: WebPlan
    console: Console
    servers: list[WebServer]
    claims: list[Claim] = field(default_factory=list)
    result: dict[str, object] = field(default_factory=dict)

    def each(self, what: str, servers: Sequence[WebServer], act: Callable[[WebServer], None]) -> None:
        """Do the same with each server; what a server other than ``rmpa web`` cannot do is left out, and said."""
        for server in servers:
            try:
                act(server)
            except BedError as error:
                if server.key == "rmpa":
                    raise
                self.leave_out(f"{what} of {server.title}", str(error))

    def leave_out(self, what: str, reason: str) -> None:
        """Say that something is left out."""
        self.console.print(f"{what} is left out: {reason}", style="yellow", markup=False)

    def claim(self, text: str, value: float | None, limit: float, *, at_least: bool = False) -> None:
        """Add what was to be reached."""
        self.claims.append(Claim(text, value, limit, at_least=at_least))


def measure(
    quick: bool, console: Console, json: Path | None = None, only: Sequence[str] = PARTS
) -> dict[str, object]:
    """Measure all parts or ``only`` these, print the tables, write the file; return the result."""
    plan = QUICK if quick else FULL
    settings: dict[str, object] = {**asdict(plan), "clients": _CLIENTS, "modules": _MODULES, "parts": list(only)}
    run = _Run(Bed(), plan, console, [])
    with run.bed:
        if {*only} - {"page"}:
            _start(run)
        for name in [name for name in _PARTS if name in only]:
            console.print(name, style="dim")
            if name == "page":
                run.bed.close()  # its agent would have a peer with 1,200 topics
            _PARTS[name](run)
    return finish(console, "web", settings, run.result, json, claims=run.claims)


def _start(run: _Run) -> None:
    """Start all servers that can run here."""
    agent = run.bed.agent()
    run.servers.append(start_rmpa(run.bed, agent))
    if reason := why_no_sdk():
        run.leave_out("foxglove-sdk", reason)
    else:
        run.servers.append(start_sdk(run.bed, agent))


# --- messages -----------------------------------------------------------------------------------------------------


def _messages(run: _Run) -> None:
    """Large messages to four clients."""
    plan, ways = run.plan, [Way(server, how) for server in run.servers for how in server.hows]
    for turn in range(plan.rounds):
        first = turn % len(ways)
        for way in [*ways, *ways][first : first + len(ways)]:
            run.each(
                f"a turn of {way.how}",
                [way.server],
                lambda _, way=way: way.measure(plan.load, _CLIENTS, run.bed.home),  # type: ignore[misc]
            )
    costs = {way.key: way.cpu_us for way in ways if way.turns}
    table = table_of(
        f"{tables.size(plan.load.size)} at {plan.load.rate:g} Hz to {_CLIENTS} clients",
        ("server", "protocol"),
        ("µs of CPU a message and client", "to rmpa web's", "% of a core", "late p50, ms", "lost, %", "RSS, MB"),
    )
    rows = []
    for way in [way for way in ways if way.turns]:
        middle = sorted(way.turns, key=lambda turn: turn.cpu_us or 0.0)[len(way.turns) // 2]
        own = ratio(costs[way.key], costs.get(f"rmpa {way.how}"))
        lost = 100 * middle.lost / (middle.sent * _CLIENTS)
        cells = [tables.us(costs[way.key]), dash(own), f"{middle.usage.percent:.1f}", f"{middle.latency_ms:.1f}"]
        table.add_row(way.server.title, way.how, *cells, f"{lost:.1f}", f"{middle.usage.rss / 1e6:.0f}")
        rows.append({
            "way": way.key,
            "cpu_us": costs[way.key],
            "cpu_us_by_turn": [turn.cpu_us for turn in way.turns],
            "cpu_percent": middle.usage.percent,
            "latency_ms": middle.latency_ms,
            "lost_percent": lost,
            "rss": middle.usage.rss,
        })  # fmt: skip
    run.console.print(table)
    run.result["messages"] = rows
    size = f"{tables.size(plan.load.size)} to {_CLIENTS} clients, CPU"
    text = f"{size}: rmpa web / foxglove-sdk (Foxglove)"
    run.claim(text, ratio(costs.get("rmpa foxglove"), costs.get("sdk foxglove")), _SDK_TARGET)


# --- a client that stops reading ----------------------------------------------------------------------------------


def _slow(run: _Run) -> None:
    """A client that stops reading, beside four that read."""
    load, rows = run.plan.slow, {}
    table = table_of(
        f"one more client that does not read; {tables.size(load.size)} at {load.rate:g} Hz for "
        f"{load.count / load.rate:g} s",
        ("server", "protocol"),
        ("memory grows by, MB", "lost by the four others", "out of order", "late p50, ms"),
    )
    ways = [Way(server, how) for server in run.servers for how in server.hows]
    for way in [way for way in ways if way.key in _SLOW_WAYS]:

        def act(_: WebServer, way: Way = way) -> None:
            found = stall(way, load, _CLIENTS, run.bed.home)
            turn = found.turn
            cells = (f"{found.growth_mb:.1f}", str(turn.lost), str(turn.unordered), f"{turn.latency_ms:.1f}")
            table.add_row(way.server.title, way.how, *cells)
            rows[way.key] = {
                "growth_mb": found.growth_mb,
                "lost": turn.lost,
                "unordered": turn.unordered,
                "latency_ms": turn.latency_ms,
                "lost_without": way.turns[0].lost,
            }

        run.each(f"a client that does not read {way.how}", [way.server], act)
    run.console.print(table)
    run.result["slow"] = rows
    ours = [rows[f"rmpa {how}"] for how in ("cbor-raw", "foxglove")]
    run.claim("a client that does not read costs, MB, the worse", max(row["growth_mb"] for row in ours), _SLOW_TARGET)
    run.claim("messages that the others lose by it", sum(row["lost"] for row in ours), 0.0)


# --- the monitor's page -------------------------------------------------------------------------------------------


def _page(run: _Run) -> None:
    """The monitor's page in a mesh of sixteen modules."""
    plan = run.plan
    with Bed() as bed, page.served_mesh(bed, bed.agent(), _MODULES) as (process, port):
        served = page.serve(process, port, plan.seconds)
        browsed = None
        if reason := page.why_no_browser():
            run.leave_out("the page in a browser", reason)
        else:
            browsed = page.browse(process, port, _MODULES, plan.seconds / 2, plan.loads)
    table = table_of("the monitor's page: 16 modules, 300 topics", (), ("figure", "value"))
    figures = {
        "rmpa web, % of a core, one page": served.cpu_percent,
        "rmpa web, RSS, MB": served.rss / 1e6,
        "patches a second": served.patches,
        "bytes of patches a second": served.patch_bytes,
        "bytes of the first state": float(served.state_bytes),
    }
    if browsed is not None:
        figures |= {
            "frames a second": browsed.frames,
            "longest frame, ms": browsed.longest_ms,
            "first paint, ms": browsed.first_paint_ms,
            "all modules shown, ms": browsed.shown_ms,
            "bytes by HTTP": float(browsed.bytes),
            "rmpa web, % of a core, with the browser": browsed.cpu_percent,
        }
    for text, value in figures.items():
        table.add_row(text, f"{value:.1f}")
    run.console.print(table)
    run.result["page"] = figures
    what = f"a page with {_MODULES} modules and 300 topics"
    run.claim(f"{what}, rmpa web, % of a core", served.cpu_percent, _PAGE_TARGET)
    run.claim(f"{what}, frames a second", browsed.frames if browsed else None, _FRAMES_TARGET, at_least=True)
    run.claim(f"{what}, first paint, ms", browsed.first_paint_ms if browsed else None, _PAINT_TARGET)
    total = (browsed.bytes + served.state_bytes) / 1e3 if browsed else None
    run.claim(f"{what}, KB of the first load with its first state", total, _BYTES_TARGET)


_PARTS: Final[dict[str, Callable[[_Run], None]]] = dict(zip(PARTS, (_messages, _slow, _page), strict=True))
