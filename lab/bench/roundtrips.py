"""One-way latency, as half of the round trip, of every path.

The contenders take turns in rounds, so that whatever else the machine does hits all alike. Through two
agents a message passes two processes more, and both ends stay unmodified ROS nodes.
"""

from __future__ import annotations

import time
from array import array
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Final

from lab import machine, samples, tables
from lab.bed.bench import Bed
from lab.bed.processes import BedError
from lab.bench.contenders import ENTRIES, SIZES, RoundTripPath
from lab.bench.schedule import HostLateness
from lab.findings import Claim
from lab.results import finish
from lab.usage import Meter, Usage, add

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table


# Round trips of each turn that are thrown away: caches and the processor's clock come up.
_WARM_UP: Final = 20
_BASE: Final = "roscpp_nodelay"
_RELAYS: Final = "relays"
# Roscpp over the same kind of cable as the agents'.
_CABLE: Final = "roscpp_hosts"
_OURS: Final = "agents_hosts"
_DIRECT: Final = "direct_hosts"
_DIRECT_LIMITS: Final = {"p50": 1.05, "p99": 1.15}
_RELAYED_LIMIT: Final = 2.0
# Percent of a core: what two looks at an idle agent differ by.
_IDLE_LIMIT: Final = 0.5
# A whole period of what agents do while nothing happens: the heartbeat's.
_IDLE_SECONDS: Final = 5.0


@dataclass(frozen=True, slots=True)
class Trips:
    """How much is measured.

    Args:
        trips: Round trips by size in bytes, over all rounds.
        rounds: Turns of each contender.
    """

    trips: dict[int, int]
    rounds: int


FULL: Final = Trips(dict(zip(SIZES, (12_000, 3_000, 1_000), strict=True)), 10)
QUICK: Final = Trips(dict(zip(SIZES, (1_000, 400, 100), strict=True)), 2)


@dataclass(slots=True)
class TripScore:
    """One contender at one size, over all rounds.

    Args:
        trips: Round trips, ns.
        lost: Those that did not come back within a second.
        usage: By process.
    """

    trips: array[int] = field(default_factory=lambda: array("Q"))
    lost: int = 0
    usage: dict[str, Usage] = field(default_factory=dict)

    @property
    def one_way(self) -> samples.Summary:
        """Half of the round trips, µs."""
        return samples.summary([trip / 2000 for trip in self.trips], self.lost)


Scores = dict[tuple[str, int], TripScore]


def path(quick: bool, console: Console, json: Path | None = None, only: Sequence[str] = ()) -> dict[str, object]:
    """Measure every path of ROS and RMPA, or ``only`` these."""
    plan = QUICK if quick else FULL
    if not machine.facts()["python_optimised"]:
        console.print(
            "this Python was built without optimisations: agents are slower than with the system's", style="yellow"
        )
    host = HostLateness()
    scores: Scores = {}
    left_out: dict[str, str] = {}
    with Bed() as bed:
        taking_part = start_all(bed, only or tuple(ENTRIES), left_out, console)
        for turn in range(plan.rounds):
            console.print(f"round {turn + 1} of {plan.rounds}", style="dim")
            first = turn % max(1, len(taking_part))  # so that none always follows the same one
            for size, trips in plan.trips.items():
                for one in [*taking_part[first:], *taking_part[:first]]:
                    try:
                        _turn(one, size, trips // plan.rounds, bed.home / "samples", scores)
                    except BedError as error:
                        left_out[one.key] = f"stopped at {tables.size(size)}: {error}"
                        console.print(f"left out from here on: {one.key}: {error}", style="red", markup=False)
                        taking_part.remove(one)
        titles = {one.key: one.title for one in taking_part}
        wanted = claims(scores)
        for one in taking_part:
            if one.key == _DIRECT:
                wanted.append(_agents_claim(one, [score for (key, _), score in scores.items() if key == _DIRECT]))
    for size in plan.trips:
        console.print(_table(size, scores, titles))
    small = min(plan.trips)
    usage = [(title, scores[key, small].usage, len(scores[key, small].trips)) for key, title in titles.items()]
    console.print(tables.usage_table(f"processes on the path, {tables.size(small)}", usage, "round trip"))
    result: dict[str, object] = {"rows": rows(scores, titles), "left_out": left_out, **host.finish(console)}
    return finish(console, "path", asdict(plan), result, json, claims=wanted)


def claims(scores: Scores) -> list[Claim]:
    """What is to be reached, of those that were measured."""
    made = []
    for size in sorted({size for _, size in scores}):
        for name, limit in _DIRECT_LIMITS.items():
            if {(_DIRECT, size), (_CABLE, size)} <= scores.keys():
                ours, base = (getattr(scores[key, size].one_way, name) for key in (_DIRECT, _CABLE))
                text = f"{tables.size(size)}, {name}, RMPA direct / roscpp over the same cable"
                made.append(Claim(text, tables.ratio(ours, base), limit))
    smallest = min((size for _, size in scores), default=0)
    for key, name, limit in ((_BASE, "roscpp direct", _RELAYED_LIMIT), (_RELAYS, "two relays", 1.0)):
        if {(_OURS, smallest), (key, smallest)} <= scores.keys():
            ours, base = (scores[of, smallest].one_way.p50 for of in (_OURS, key))
            made.append(Claim(f"{tables.size(smallest)}, p50, two agents / {name}", tables.ratio(ours, base), limit))
    return made


def _agents_claim(one: RoundTripPath, scores: Sequence[TripScore]) -> Claim:
    """What both agents used while their nodes talked directly, beyond what they use while nothing happens."""
    agents = {name: process.pid for name, process in one.processes.items() if name.startswith("agent")}
    meter = Meter(agents)
    time.sleep(_IDLE_SECONDS)
    idle = sum(used.percent for used in meter.read().values())
    busy = [score.usage[name] for score in scores for name in agents]
    wall = sum(used.wall for used in busy) / len(agents)
    share = 100 * sum(used.cpu for used in busy) / wall
    text = "processor time of both agents while nodes talk directly, less idle"
    return Claim(text, round(share - idle, 3), _IDLE_LIMIT, unit="% of a core")


def start_all(bed: Bed, keys: Sequence[str], left_out: dict[str, str], console: Console) -> list[RoundTripPath]:
    """Start all that can take part, and stop them until their turn; say why the others cannot, and note it."""
    taking_part = []
    for key in keys:
        reason = ENTRIES[key].why_not()
        if not reason:
            try:
                made = ENTRIES[key].start(bed)
            except BedError as error:
                reason = f"did not start: {error}"
            else:
                for process in made.still:
                    process.freeze()
                taking_part.append(made)
                continue
        left_out[key] = reason
        console.print(f"left out: {key}: {reason}", style="yellow", markup=False)
    return taking_part


def _turn(one: RoundTripPath, size: int, trips: int, scratch: Path, scores: Scores) -> None:
    with one.awake():
        one.round(size, _WARM_UP, scratch)
        times, lost, usage = one.round(size, trips, scratch)
    score = scores.setdefault((one.key, size), TripScore())
    score.trips.extend(times)
    score.lost += lost
    score.usage = add(score.usage, usage)


def _ratios(scores: Scores, key: str, size: int) -> dict[str, float | None]:
    """The median as a multiple of direct roscpp's, of the relays' and of roscpp's over a cable; and ours of it."""

    def median(of: str) -> float | None:
        return scores[of, size].one_way.p50 if (of, size) in scores else None

    return {
        "to_roscpp": tables.ratio(median(key), median(_BASE)),
        "to_relays": tables.ratio(median(key), median(_RELAYS)),
        "agents_to_it": tables.ratio(median(_OURS), median(key)),
        "to_roscpp_hosts": tables.ratio(median(key), median(_CABLE)),
    }


def rows(scores: Scores, titles: dict[str, str]) -> list[dict[str, object]]:
    """For the result: one for each contender that lasted, and each size."""
    return [
        {
            "contender": key,
            "title": titles[key],
            "bytes": size,
            "one_way_us": asdict(score.one_way),
            **_ratios(scores, key, size),
            "processes": {name: tables.usage_row(usage, len(score.trips)) for name, usage in score.usage.items()},
        }
        for (key, size), score in scores.items()
        if key in titles
    ]


def _table(size: int, scores: Scores, titles: dict[str, str]) -> Table:
    heads = (
        "p50",
        "p95",
        "p99",
        "p99.9",
        "max",
        "trips",
        "lost",
        "to roscpp",
        "to relays",
        "agents to it",
        "to roscpp, cable",
    )
    table = tables.table_of(f"one way, {tables.size(size)}, µs", ("between the two nodes",), heads)
    for key, title in titles.items():
        row = scores[key, size].one_way
        ratios = map(tables.dash, _ratios(scores, key, size).values())
        table.add_row(title, *tables.percentiles(row), str(row.count), str(row.lost), *ratios)
    return table
