"""A command beside images on a link of 100 Mbit/s: classic ROS and RMPA, each on a shaped cable of its own.

The images are offered faster than the link carries, so that there is always one waiting. Both directions are shaped:
acknowledgements take their time too.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Final

from lab.bed.bench import Bed
from lab.bench import schedule
from lab.experiments.images import DEADLINE, IMAGE, IMAGE_QUEUE, IMAGE_RATE, MIXED_CONTRACTS, RATE, SIZE
from lab.figures import shapes
from lab.findings import Claim
from lab.results import finish
from lab.tables import dash, percentiles, ratio, table_of, usage_table

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from lab.bed.plan import Transport

_LINK: Final = 100e6
"""Bits a second, as tbf counts them: with Ethernet's headers."""
_AHEAD: Final = 2.0
"""Seconds of images before the first command that counts: queues are full then."""
_MIXED: Final = schedule.AgentPair("agents_mixed", "images direct, command relayed", "relay", MIXED_CONTRACTS)
_NO_WORSE: Final = 1.1
"""Of a p99 of 10,000 commands: two runs of one way differ by that."""


FULL: Final = schedule.Rounds(20.0, 5)
QUICK: Final = schedule.Rounds(8.0, 2)


class LoadedScore(schedule.LatencyScore):
    """Commands beside images, and the images."""

    def __init__(self) -> None:
        super().__init__()
        self.images = schedule.LatencyScore()
        self.throughput: list[float] = []

    def add_images(self, images: schedule.Arrivals, commands: schedule.Arrivals) -> None:
        """Take the images of one round; only those count that came while commands were due."""
        self.images.add(images)
        if commands.due:
            self.throughput.append(images.bytes_per_second(IMAGE, commands.due[0], commands.due[-1]))

    @property
    def share(self) -> float | None:
        """What the images got of the link, payload only: Ethernet, IP and TCP take 4.3 % themselves."""
        return 8 * sum(self.throughput) / len(self.throughput) / _LINK if self.throughput else None


Scores = dict[tuple[str, str], LoadedScore]


def measure(quick: bool, console: Console, json: Path | None = None, *, realtime: bool = False) -> dict[str, object]:
    """Measure, print the tables, write the files; return the result."""
    plan = QUICK if quick else FULL
    host = schedule.HostLateness()
    scores, titles, how = _take(plan, console, realtime=realtime)
    console.print(_table(scores, titles))
    console.print(_image_table(scores, titles))
    rows = [
        (titles[key], one.usage, one.messages) for (key, condition), one in scores.items() if condition == "loaded"
    ]
    console.print(
        usage_table("processes on the path beside images (the publisher's and receiver's of commands)", rows)
    )
    result: dict[str, object] = {
        "rows": [_row(key, condition, one, scores) for (key, condition), one in scores.items()],
        "scheduling": how,
        **host.finish(console),
    }
    settings = {
        **asdict(plan),
        "bytes": SIZE,
        "hz": RATE,
        "image_bytes": IMAGE,
        "image_hz": IMAGE_RATE,
        "link_bits_per_s": _LINK,
    }
    return finish(
        console,
        schedule.named("crosstraffic", realtime=realtime),
        settings,
        result,
        json,
        claims=_targets(scores),
        panels=shapes.tails(_panels(scores, titles), "from due to there, µs", DEADLINE),
    )


def _take(plan: schedule.Rounds, console: Console, *, realtime: bool) -> tuple[Scores, dict[str, str], str]:
    """The scores, the ways' titles by key, and how all that ran was scheduled."""
    scores: Scores = {}
    with Bed() as bed:
        ways, fifo, how = schedule.direct_and_agents(
            bed, (schedule.RELAYED, schedule.DIRECT, _MIXED), realtime=realtime
        )
        console.print(how, style="dim")
        streams = {}
        for way in ways:
            for shell in (way.here, way.there):
                shell.host.shape(f"{_LINK / 1e6:.0f}mbit", bands=True)  # as on a real card
            # The images' nodes are the less urgent ones of the user's, too.
            transport: Transport | None = "direct" if way.key == _MIXED.key else None
            images = way.stream(bed, "/image", queue=IMAGE_QUEUE, fifo=fifo and fifo - 1, transport=transport)
            streams[way.key] = way.stream(bed, "/command", fifo=fifo), images
        for order in schedule.turns(ways, plan.rounds, console):
            for way in order:
                for condition in ("unloaded", "loaded"):
                    score = scores.setdefault((way.key, condition), LoadedScore())
                    _round(*streams[way.key], plan.seconds, score, loaded=condition == "loaded")
    return scores, {way.key: way.title for way in ways}, how


def _targets(scores: Scores) -> list[Claim]:
    ours, idle, mixed = scores["agents", "loaded"], scores["agents", "unloaded"], scores[_MIXED.key, "loaded"]
    return [
        Claim("p99 beside images, ms", _ms(ours.summary.p99), 1.0),
        Claim("p99 beside images / unloaded", ratio(ours.summary.p99, idle.summary.p99), 3.0),
        Claim("images, share of the link", ours.share, 0.9, at_least=True),
        Claim(
            "p99 beside images, images direct and command relayed / both relayed",
            ratio(mixed.summary.p99, ours.summary.p99),
            _NO_WORSE,
        ),
        Claim("direct images beside a relayed command, share of the link", mixed.share, 0.9, at_least=True),
    ]


def _round(
    command: schedule.MeasuredStream,
    image: schedule.MeasuredStream,
    seconds: float,
    score: LoadedScore,
    *,
    loaded: bool,
) -> None:
    if loaded:
        image.begin(IMAGE, IMAGE_RATE, _AHEAD + seconds + 1.0)
        image.wait_lead_in(_AHEAD)
    commands = command.run(SIZE, RATE, seconds)
    score.add(commands)
    if loaded:
        score.add_images(image.end(), commands)


def _ms(value: float | None) -> float | None:
    return None if value is None else value / 1000


def _row(key: str, condition: str, one: LoadedScore, scores: Scores) -> dict[str, object]:
    idle, classic = scores[key, "unloaded"].summary, scores["direct", condition].summary
    row = {
        "way": key,
        "condition": condition,
        **one.row(DEADLINE),
        "p99_to_unloaded": ratio(one.summary.p99, idle.p99),
        "p99_to_direct": ratio(one.summary.p99, classic.p99),
    }
    if one.throughput:
        row["images"] = {
            "share_of_link": one.share,
            "mb_per_s_by_round": [value / 1e6 for value in one.throughput],
            "latency_us": asdict(one.images.summary),
            "sent": one.images.messages,
        }
    return row


def _table(scores: Scores, titles: dict[str, str]) -> Table:
    heads = ("p50", "p95", "p99", "p99.9", "max", "count", "lost", ">1 ms", "to unloaded", "to classic")
    table = table_of(
        f"a command of {SIZE} B at {RATE:.0f} Hz on {_LINK / 1e6:.0f} Mbit/s, from due to there, µs",
        ("way", "beside"),
        heads,
    )
    for condition, beside in (("unloaded", "nothing"), ("loaded", "images")):
        for key, title in titles.items():
            one = scores[key, condition]
            row = one.summary
            cells = percentiles(row)
            counts = [str(row.count), str(row.lost), f"{100 * one.later_than(DEADLINE):.2f} %"]
            bases = (scores[key, "unloaded"].summary.p99, scores["direct", condition].summary.p99)
            table.add_row(title, beside, *cells, *counts, *[dash(ratio(row.p99, base)) for base in bases])
    return table


def _image_table(scores: Scores, titles: dict[str, str]) -> Table:
    table = table_of(
        f"images of 1 MB, {IMAGE_RATE} Hz offered ({8 * IMAGE * IMAGE_RATE / _LINK:.2f} of the link)",
        ("way",),
        ("MB/s", "share of the link", "to classic", "p50 late, ms", "max, ms", "came", "dropped"),
    )
    for key, title in titles.items():
        one = scores[key, "loaded"]
        row = one.images.summary
        rate = sum(one.throughput) / len(one.throughput) / 1e6 if one.throughput else 0.0
        share = ratio(one.share, scores["direct", "loaded"].share)
        late = [dash(_ms(value)) for value in (row.p50, row.largest)]
        table.add_row(title, f"{rate:.2f}", dash(one.share), dash(share), *late, str(row.count), str(row.lost))
    return table


def _panels(scores: Scores, titles: dict[str, str]) -> dict[str, dict[str, list[float]]]:
    panels: dict[str, dict[str, list[float]]] = {"unloaded": {}, "loaded": {}}
    for (key, condition), one in scores.items():
        panels[condition][titles[key]] = list(one.latencies)
    return panels
