"""A bad radio between two hosts: classic ROS and RMPA relayed, each on a cable and a switch of its own.

The switch loses packets at random in both directions, or its ports have the queue: 100 ms of it at 20 Mbit/s, behind
the host, where the host's priorities do not reach; or it drops all packets for two seconds while both carriers stay.
All hosts use *cubic*, as Linux does by default.
"""

from __future__ import annotations

import statistics
import subprocess
import time
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Final

from lab.bed.bench import Bed
from lab.bench import schedule
from lab.findings import Claim
from lab.results import finish
from lab.tables import dash, table_of

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rich.console import Console
    from rich.table import Table

    from lab.bed.namespaces import Host
    from lab.bench.schedule import Way

_SIZE: Final = 64
_RATE: Final = 50.0
# µs within which a command is in time.
_DEADLINE: Final = 50_000.0
# Seconds without an arrival that end a round: the pauses of TCP's repetitions are part of the figures.
_SETTLE: Final = 2.0
_QUEUE_RATE: Final = "20mbit"
_QUEUE: Final = "100ms"
_IMAGE: Final = 100_000
# Hz; 24 Mbit/s, more than the link carries.
_IMAGE_RATE: Final = 30.0
_IMAGE_QUEUE: Final = 2
# Seconds of images before the first command that counts: the queue is full then.
_AHEAD: Final = 2.0
_CUT: Final = 2.0
_CUT_AFTER: Final = 1.5
_CUT_ROUND: Final = 9.0
_COMMAND: Final = """\
[[contract]]
topics = ["/command"]
priority = "high"
depth = 1
lifespan = "100 ms"
"""
_RELAYED: Final = schedule.AgentPair("agents", "RMPA relayed", "relay", _COMMAND)
# Percent of the packets, by part.
_LOSS: Final = {"loss_1": 1, "loss_5": 5, "loss_20": 20}
PARTS: Final = ("quiet", *_LOSS, "queue", "cut")

FULL: Final = schedule.Rounds(20.0, 5)
QUICK: Final = schedule.Rounds(8.0, 1)


@dataclass(slots=True)
class RadioScore:
    """The commands of one way in one part, the images beside them, and its interruptions."""

    commands: schedule.LatencyScore = field(default_factory=schedule.LatencyScore)
    # A second, of each round.
    images: list[float] = field(default_factory=list)
    # Of each cut: ms from its end to the first command that came in time.
    back: list[float] = field(default_factory=list)

    def row(self) -> dict[str, object]:
        """For the result."""
        made: dict[str, object] = {
            "within_deadline": 1 - self.commands.later_than(_DEADLINE),
            "within_deadline_by_round": [_within(one) for one in self.commands.rounds],
            **self.commands.row(_DEADLINE),
        }
        if self.images:
            made["images_per_s"] = self.images
        if self.back:
            made["back_after_ms"] = self.back
        return made


Scores = dict[tuple[str, str], RadioScore]


def measure(
    quick: bool, console: Console, json: Path | None = None, parts: Sequence[str] = PARTS
) -> dict[str, object]:
    """Measure the parts in turn, print the tables, write the files; return the result."""
    plan = QUICK if quick else FULL
    scores: Scores = {}
    with Bed() as bed:
        ways = [schedule.direct(bed), schedule.agents(bed, _RELAYED, network=1)]
        for way in ways:
            for shell in (way.here, way.there):
                _use_cubic(shell.host)
        commands = {way.key: way.stream(bed, "/command", queue=1) for way in ways}
        images = {way.key: way.stream(bed, "/image", queue=_IMAGE_QUEUE) for way in ways if "queue" in parts}
        for order in schedule.turns(ways, plan.rounds, console):
            for part in parts:
                for way in order:
                    score = scores.setdefault((part, way.key), RadioScore())
                    _disturbed(part, way, commands[way.key], images.get(way.key), plan.seconds, score)
                    commands[way.key].wait_flowing()
    titles = {way.key: way.title for way in ways}
    console.print(_table(scores, titles))
    settings = {
        **asdict(plan),
        "parts": list(parts),
        "bytes": _SIZE,
        "hz": _RATE,
        "image_bytes": _IMAGE,
        "image_hz": _IMAGE_RATE,
        "queue": f"{_QUEUE_RATE}, {_QUEUE}",
        "cut_s": _CUT,
        "congestion_control": "cubic",
    }
    result: dict[str, object] = {
        "rows": [{"part": part, "way": way, **one.row()} for (part, way), one in scores.items()],
    }
    return finish(console, "radio", settings, result, json, claims=_targets(scores))


def _disturbed(
    part: str,
    way: Way,
    command: schedule.MeasuredStream,
    image: schedule.MeasuredStream | None,
    seconds: float,
    score: RadioScore,
) -> None:
    """Measure one round of one part, and take its disturbance away."""
    host = way.there.host
    if part == "cut":
        _cut(host, command, score)
    elif part == "queue" and image is not None:
        hosts = (way.here.host, way.there.host)
        for each in hosts:
            _queue(each)
        image.begin(_IMAGE, _IMAGE_RATE, _AHEAD + seconds + 1.0)
        image.wait_lead_in(_AHEAD)
        came = command.run(_SIZE, _RATE, seconds, settle=_SETTLE)
        score.commands.add(came)
        if came.due:
            shown = image.end()
            score.images.append(shown.bytes_per_second(1, came.due[0], came.due[-1]))
        for each in hosts:
            _switch(each, "tc", "qdisc", "del", "dev", each.cables[0].port, "root")
    else:
        if part in _LOSS:
            rule = f"numgen random mod 100 < {_LOSS[part]} drop"
            chain = "add chain bridge radio lost { type filter hook forward priority 0; }"
            _switch(host, "nft", f"add table bridge radio; {chain}; add rule bridge radio lost {rule}")
        score.commands.add(command.run(_SIZE, _RATE, seconds, settle=_SETTLE))
        if part in _LOSS:
            _switch(host, "nft", "delete table bridge radio")


def _cut(host: Host, command: schedule.MeasuredStream, score: RadioScore) -> None:
    command.begin(_SIZE, _RATE, _CUT_ROUND)
    command.wait_lead_in(_CUT_AFTER)
    host.dropout(_CUT)
    restored = time.monotonic_ns()
    came = command.end(settle=_SETTLE)
    score.commands.add(came)
    again = [
        at for due, at in zip(came.due, came.came, strict=True) if due > restored and at - due < 1000 * _DEADLINE
    ]
    score.back.append((again[0] - restored) / 1e6 if again else 1000 * _CUT_ROUND)


def _queue(host: Host) -> None:
    """Let the switch keep what it sends to a host in a queue of its own."""
    port = host.cables[0].port
    _switch(
        host, "tc", "qdisc", "replace", "dev", port, "root", "tbf",
        "rate", _QUEUE_RATE, "burst", "16kb", "latency", _QUEUE,
    )  # fmt: skip


def _use_cubic(host: Host) -> None:
    wire = host.cables[0]
    net = f"{wire.address.rpartition('.')[0]}.0/24"
    host.ip("route", "replace", net, "dev", wire.interface, "src", wire.address, "congctl", "cubic")


def _switch(host: Host, *argv: str) -> None:
    """Run a command in the switch of a host's network."""
    where = ["ip", "netns", "exec", host.cables[0].switch]
    subprocess.run([*where, *argv], check=True, capture_output=True, timeout=20)


def _within(latencies: Sequence[float]) -> float:
    return sum(late <= _DEADLINE for late in latencies) / len(latencies) if latencies else 0.0


def _targets(scores: Scores) -> list[Claim]:
    made = []
    for part, least in (("loss_5", 0.99), ("loss_20", 0.85), ("queue", 0.99)):
        if (part, _RELAYED.key) in scores:
            share = 1 - scores[part, _RELAYED.key].commands.later_than(_DEADLINE)
            made.append(Claim(f"commands within 50 ms, {part}", share, least, at_least=True))
    if back := scores.get(("cut", _RELAYED.key), RadioScore()).back:
        made.append(Claim(f"back after a cut of {_CUT:g} s, ms", statistics.median(back), 500.0))
    return made


def _table(scores: Scores, titles: dict[str, str]) -> Table:
    table = table_of(
        f"a command of {_SIZE} B at {_RATE:.0f} Hz, from due to there, ms",
        ("part", "way"),
        ("within 50 ms", "p50", "p99", "max", "never came", "images/s", "back after, ms"),
    )
    for (part, key), one in scores.items():
        found = one.commands.summary
        late = [dash(None if value is None else value / 1000) for value in (found.p50, found.p99, found.largest)]
        share = f"{100 * (1 - one.commands.later_than(_DEADLINE)):.1f} %"
        images, back = (dash(statistics.median(values) if values else None) for values in (one.images, one.back))
        table.add_row(part, titles[key], share, *late, str(found.lost), images, back)
    return table
