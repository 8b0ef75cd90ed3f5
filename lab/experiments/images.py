"""Experiment 6: commands beside images on one shaped cable."""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import pandas as pd

from lab import frames
from lab.experiments import flow
from lab.experiments.contenders import CLASSIC, COMPARED, MIXED, RMPA, contender_of, system_of, transport_of, turn
from lab.experiments.model import Cell, Measured, Results, Value
from lab.experiments.payload import bits_per_second
from lab.findings import Claim, Figure, Findings, Grid, Panel, Series
from lab.frames import counting_from
from lab.samples import summary
from lab.statistics import distribution, median
from lab.words import counted

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from lab.bed.plan import Client, Plan, Transport
    from lab.bed.processes import Process
    from lab.bed.stage import Stage
    from lab.bed.system import System
    from lab.experiments.contenders import Contender

HOSTS: Final = ("joystick", "pc")
# Where the plan has none: the experiment is about a cable that is full.
_LINK: Final = "100mbit"
SIZE, RATE = 64, 100.0
IMAGE: Final = 1024 * 1024
# Hz; 127 Mbit/s, and no divisor of the commands' rate, so that the two drift past each other.
IMAGE_RATE: Final = 15.1
IMAGE_QUEUE: Final = 2
# Seconds of each round of commands that are thrown away: caches and the processor's clock come up.
_LEAD_IN: Final = 0.2
_FLOWING_WITHIN: Final = 30.0
# µs.
DEADLINE: Final = 1000.0
# ms: "tens".
_CLASSIC_LIMIT: Final = 10.0
_SHARE_LIMIT: Final = 0.9
# Images below which nothing is said of their share.
_ENOUGH_IMAGES: Final = 100
# No worse than with both relayed: of 4,000 commands the p99 has a standard error of some 3 %, their ratio one of 4 %.
_MIXED_LIMIT: Final = 1.1
_SHOWN: Final = (*COMPARED, MIXED)
# Part of every agent's ``rmpa.toml`` where images are direct and commands relayed.
MIXED_CONTRACTS: Final = """\
[[contract]]
topics = ["/cmd", "/command"]
transport = "relay"

[[contract]]
topics = ["/image"]
transport = "direct"

"""


@dataclass(frozen=True, slots=True)
class ImageTimes:
    """Seconds of a cell.

    Args:
        alone: Of commands with nothing beside them.
        ahead: Of images before the first command that counts: queues are full then.
        beside: Of commands beside images.
        rounds: Cells of each system and client.
    """

    alone: float
    ahead: float
    beside: float
    rounds: int


_FULL: Final = ImageTimes(5.0, 2.0, 20.0, 2)
_SHORT: Final = ImageTimes(0.3, 0.3, 1.0, 1)


class _Stream:
    """One topic from the one host to the other.

    Args:
        system: The two hosts.
        client: Whose nodes.
        topic: Its name.
        queue: Of the publisher.
        stage: Where files go.
        way: Its transport; ``None``: the system's.
    """

    def __init__(
        self, system: System, client: Client, topic: str, queue: int, stage: Stage, way: Transport | None
    ) -> None:
        here, there = HOSTS
        self.sink: Process = system.node(there, "sink", client, topics=topic, nodelay=True)
        self.source: Process = system.node(here, "source", client, topic=topic, queue=queue)
        self._topic = topic
        self._scratch = stage.scratch
        flow.wait_flowing(self.source, self.sink, [topic], self._scratch, timeout=_FLOWING_WITHIN)
        self._check = functools.partial(system.require_transport, [(self.source, self.sink)], way)
        self._check()

    def begin(self, size: int, rate: float, seconds: float) -> flow.Round:
        """Let it send for so long."""
        return flow.begin(self.source, self._scratch, size=size, rate=rate, count=max(2, round(rate * seconds)))

    def end(self, begun: flow.Round) -> tuple[pd.DataFrame, int]:
        """The arrivals of a round (``sequence``, ``due_ns``, ``came_ns``), and the number of messages sent."""
        sent = len(flow.sent(begun))
        self._check()
        return flow.noted(self.sink, [self._topic], self._scratch, begun.number).drop(columns="topic"), sent


_ABOUT: Final = f"""\
*joystick* sends commands of {SIZE} B at {RATE:g} Hz and images of 1 MB at {IMAGE_RATE:g} Hz to *pc*, each by a
node of its own. The cable carries 100 Mbit/s, less than the images alone would need, so that there is always one
waiting. Packets leave by the kernel's usual three bands (`pfifo_fast` inside `tbf`). Classic ROS has a connection for
each topic, with tcp_nodelay. RMPA stands there three times: both relayed, both direct from node to node, and images
direct beside commands that are relayed. Latency runs from when a command was due.
"""


class Images:
    """The experiment."""

    name: Final = "images"
    title: Final = "6. Commands beside images"
    about: Final = _ABOUT

    def cells(self, plan: Plan) -> list[Cell]:
        """Rounds of all in turns, with each client; the short form leaves out the mixture."""
        times = _times(plan)
        seconds = 5.0 + times.alone + times.ahead + times.beside
        return [
            Cell(self.name, {**one.kind_settings, "client": client, "nodelay": True, "round": number}, seconds)
            for number in range(1, times.rounds + 1)
            for client in (plan.clients[-1:] if plan.short else plan.clients)
            for one in turn(COMPARED if plan.short else _SHOWN, number - 1)
        ]

    def measure(self, cell: Cell, stage: Stage) -> Measured:
        """Commands alone, then beside images."""
        client: Client = cell.settings["client"]  # type: ignore[assignment]  # cells() put it there
        times = _times(stage.plan)
        link = stage.plan.link or _LINK
        contender = contender_of(cell)
        mixed: Transport | None = "direct" if contender == MIXED else None
        config = MIXED_CONTRACTS if mixed else ""
        with stage.system(system_of(cell), HOSTS, link=link, way=transport_of(cell), config=config) as system:
            commands = _Stream(system, client, "/cmd", 100, stage, None)
            images = _Stream(system, client, "/image", IMAGE_QUEUE, stage, mixed)
            alone, alone_sent = commands.end(commands.begin(SIZE, RATE, _LEAD_IN + times.alone))
            taken = images.begin(IMAGE, IMAGE_RATE, times.ahead + _LEAD_IN + times.beside + 1.0)
            time.sleep(times.ahead)
            among, among_sent = commands.end(commands.begin(SIZE, RATE, _LEAD_IN + times.beside))
            pictures, pictures_sent = images.end(taken)
        lead = round(RATE * _LEAD_IN)
        counted_in = {"alone": counting_from(alone, lead), "images": counting_from(among, lead)}
        tables = {
            "commands": pd.concat(counted_in, names=["beside"]).reset_index("beside").reset_index(drop=True),
            "images": pictures,
        }
        facts: dict[str, Value] = {
            "link": link,
            "alone": alone_sent - lead,
            "beside": among_sent - lead,
            "images": pictures_sent,
        }
        return Measured(tables, facts)

    def findings(self, results: Results) -> Findings:
        """The commands' latency, the images' share, and the claims."""
        if not results.cells:
            return Findings()
        clients = list(dict.fromkeys(str(cell.settings["client"]) for cell, _ in results.cells))
        found = {
            (client, contender): [
                one for cell, one in results.select(client=client) if contender_of(cell) == contender
            ]
            for client in clients
            for contender in _SHOWN
        }
        scores = {key: _score(rounds) for key, rounds in found.items() if rounds}
        return Findings(
            figures=tuple(_figure(client, scores) for client in clients),
            grids=(_commands(scores), _images(scores)),
            claims=tuple(_claims(scores)),
            notes=_NOTES if any(score.shares for score in scores.values()) else (),
        )


def _times(plan: Plan) -> ImageTimes:
    return _SHORT if plan.short else _FULL


# --- what follows ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ImageScore:
    """One system with one client, over all rounds.

    Args:
        latencies: Of commands from due to there, µs, by what was beside them.
        lost: Commands that never came, likewise.
        shares: What the images got of the link while commands were due, payload only, by round.
        speeds: The same in MB (1e6) a second.
        images: From due to there, ms.
        dropped: Images that never came: more are offered than the cable carries.
    """

    latencies: Mapping[str, Sequence[float]]
    lost: Mapping[str, int]
    shares: Sequence[float]
    speeds: Sequence[float]
    images: Sequence[float]
    dropped: int


def _score(rounds: Sequence[Measured]) -> ImageScore:
    latencies: dict[str, list[float]] = {"alone": [], "images": []}
    lost = {"alone": 0, "images": 0}
    shares, speeds, late = [], [], []
    dropped = 0
    for one in rounds:
        commands, pictures = one.tables["commands"].drop_duplicates(["beside", "sequence"]), one.tables["images"]
        for beside, fact in (("alone", "alone"), ("images", "beside")):
            came = frames.latencies(commands, beside=beside)
            latencies[beside] += [1000 * ms for ms in came]
            lost[beside] += max(0, _int(one.facts[fact]) - len(came))
        late += frames.latencies(pictures)
        dropped += max(0, _int(one.facts["images"]) - len(pictures))
        dues = frames.where(commands, beside="images")["due_ns"].tolist()
        if dues and (speed := bytes_per_second(pictures["came_ns"].tolist(), min(dues), max(dues))):
            speeds.append(speed / 1e6)
            if link := str(one.facts["link"]):
                shares.append(8 * speed / bits_per_second(link))
    return ImageScore(latencies, lost, shares, speeds, late, dropped)


def bytes_per_second(came: Sequence[int], begin: int, end: int) -> float:
    """Bytes a second of the images that came between two moments of the clock (ns); 0 if fewer than two came."""
    inside = sorted(at for at in came if begin <= at <= end)
    return IMAGE * (len(inside) - 1) / (inside[-1] - inside[0]) * 1e9 if len(inside) > 1 else 0.0


def _int(value: object) -> int:
    return int(str(value))


Scores = dict[tuple[str, "Contender"], ImageScore]


def _figure(client: str, scores: Scores) -> Figure:
    panels = []
    for beside, title in (("alone", "nothing beside"), ("images", "beside images")):
        series = []
        for one in (one for of, one in scores if of == client):
            found = [value / 1000 for value in scores[client, one].latencies[beside]]
            series.append(Series(one.label, *distribution(found, tail=True), style="steps", system=one.look))
        panels.append(
            Panel(
                f"commands, {title} ({client})",
                "from due to there, ms",
                "share that is later",
                tuple(series),
                logx=True,
                logy=True,
                moments={"1 ms": 1.0},
            )
        )
    return Figure(
        f"images-{client}",
        f"Commands of {SIZE} B at {RATE:g} Hz on a full cable ({client})",
        "The share of commands that came later than so many ms; the lower left is good.",
        tuple(panels),
    )


def _commands(scores: Scores) -> Grid:
    heads = ("nodes", "system", "beside", "p50, ms", "p95", "p99", "p99.9", "max", "count", "lost", "later than 1 ms")
    rows = []
    for (client, one), score in scores.items():
        for beside, title in (("alone", "nothing"), ("images", "images")):
            found = summary(score.latencies[beside])
            figures = [found.p50, found.p95, found.p99, found.p999, found.largest]
            cells = [counted(value, factor=1e-3) for value in figures]
            counts = (str(found.count), str(score.lost[beside]), _later(score, beside))
            rows.append((client, one.label, title, *cells, *counts))
    note = "From due to there. A percentile is given only where ten samples lie beyond it."
    return Grid("Commands", heads, rows, note)


def _later(score: ImageScore, beside: str) -> str:
    late = sum(value > DEADLINE for value in score.latencies[beside]) + score.lost[beside]
    sent = len(score.latencies[beside]) + score.lost[beside]
    return f"{100 * late / sent:.2f} %" if sent else "-"


def _images(scores: Scores) -> Grid:
    heads = ("nodes", "system", "MB/s", "share of the cable", "due to there: p50, ms", "max, ms", "came", "dropped")
    rows = []
    for (client, one), score in scores.items():
        figures = [_mean(score.speeds), _mean(score.shares), median(score.images), max(score.images, default=None)]
        counts = (str(len(score.images)), str(score.dropped))
        rows.append((client, one.label, *(counted(value) for value in figures), *counts))
    note = (
        f"1 MB at {IMAGE_RATE:g} Hz are offered, 1.27 of the cable; what does not fit is dropped by the"
        " publisher, which keeps two. The share is of payload only: Ethernet, IP and TCP take 4.3 % themselves."
    )
    return Grid("Images", heads, rows, note)


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _claims(scores: Scores) -> Iterable[Claim]:
    for (client, one), score in scores.items():
        p99 = _p99(score)
        value = None if p99 is None else p99 / 1000
        if one == CLASSIC:
            text = f"commands beside images, p99, classic, {client}"
            yield Claim(text, value, _CLASSIC_LIMIT, at_least=True, unit="ms")
        elif one == RMPA:
            yield Claim(f"commands beside images, p99, RMPA, {client}", value, DEADLINE / 1000, unit="ms")
        elif one == MIXED and (client, RMPA) in scores:
            base = _p99(scores[client, RMPA])
            text = f"commands beside images, p99, {client}: images direct, commands relayed / both relayed"
            yield Claim(text, p99 / base if p99 and base else None, _MIXED_LIMIT)
        if one != CLASSIC:
            share = _mean(score.shares) if len(score.images) >= _ENOUGH_IMAGES else None
            yield Claim(f"images' share of the cable, {one.label}, {client}", share, _SHARE_LIMIT, at_least=True)


def _p99(score: ImageScore) -> float | None:
    """Of commands beside images, µs; ``None`` without a cable that they fill."""
    return summary(score.latencies["images"], score.lost["images"]).p99 if score.shares else None


_NOTES: Final = (
    (
        "Classic ROS is better here than its reputation: each topic has a connection of its own, and the kernel"
        " lets each put only a few ms of data into the card's queue (TCP small queues). A command waits for those"
        " few ms, not for whole images; tens of ms are what a single connection for both would take."
    ),
    (
        "An image that a subscriber takes late is no loss to the cable: all of them fill it. Relayed by RMPA, some"
        " more of them are on the way, so each is older when it comes."
    ),
)

EXPERIMENT: Final = Images()
