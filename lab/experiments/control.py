"""Experiment 1: the rates at which commands and velocities come, and the control computation delay.

Section 5 of the paper, Figs. 8 and 9 and Table 1: a joystick sends commands (CMD) at 10 Hz, the velocity host turns
each into a velocity order (VEL), the base takes those, and the pc receives both.
"""

from __future__ import annotations

import functools
import itertools
import random
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, cast

from lab import statistics
from lab.experiments import flow
from lab.experiments.contenders import (
    CLASSIC,
    COMPARED,
    DEFAULTS,
    DIRECT,
    RELAYS,
    RMPA,
    nodelay_of,
    relays_of,
    system_of,
    transport_of,
    turn,
)
from lab.experiments.model import Cell, Measured, Results, Value
from lab.findings import Claim, Figure, Findings, Grid, Panel, Series
from lab.frames import counting_from, pairs, source_periods
from lab.words import counted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from lab.bed.plan import Client, Plan
    from lab.bed.stage import Stage
    from lab.bed.system import System
    from lab.experiments.contenders import Contender

# Hz, of commands and of the polling velocity node; the paper's.
RATE: Final = 10.0
HOSTS: Final = ("joystick", "velocity", "base", "pc")
CMD: Final = "/cmd"
VEL: Final = "/vel"
# For each topic the publishing host, and the subscribing ones.
_FLOWS: Final = {CMD: ("joystick", "velocity", "pc"), VEL: ("velocity", "base", "pc")}
# The paper's velocity node, which looks for a command at 10 Hz, and one that takes each as it comes.
MODES: Final = ("polled", "event")
_NODES: Final = {"polled": "polled velocity node", "event": "event-driven velocity node"}
# Bytes of a message: about a Joy's or a Twist's.
_SIZE: Final = 64
# Messages at the beginning of a round that are not counted.
_LEAD: Final = 2
_MESSAGES: Final = {"short": 10, "full": 100}
_ROUNDS: Final = {"short": 1, "full": 4}
# Of classic ROS without tcp_nodelay: a figure beside the others, on which no claim rests.
_DEFAULTS_ROUNDS: Final = 1
_RELAYS_ROUNDS: Final = 3
# Seconds until a system of four hosts and its nodes are up, about.
_SETUP: Final = 4.5
# From both ends of a period no phase is taken: there, chance would add a whole period to one of two equal delays.
_MARGIN_MS: Final = 10.0
# Below that, one bad moment of the machine decides a ratio.
_ROUNDS_NEEDED: Final = 3
_JITTER_LIMIT: Final = 1.1
_DELAY_LIMITS_MS: Final = {RMPA: 0.2, DIRECT: 0.05}
# As many processes on the way, each at its best.
_RELAYS_LIMIT: Final = 1.0
# No worse: within a hundredth, which is half a ms of the mean of 50.
_POLLED_LIMIT: Final = 1.01
# Of means and deviations: as many as the paper has.
_DIGITS: Final = 4

_QUANTITIES: Final = {"cmd": "Command Order", "vel": "Velocity Order", "delay": "Control Computation Delay"}
_PAPER: Final = {
    # Table 1: mean of RMPA and ROS, standard deviation of RMPA and ROS, in seconds.
    "cmd": (0.0999, 0.0999, 5.059e-4, 2.724e-4),
    "vel": (0.0999, 0.0999, 5.006e-4, 3.2e-4),
    "delay": (0.0613, 0.1038, 4.91e-4, 1.2e-4),
}

_ABOUT: Final = """\
The paper's robot: *joystick* publishes CMD at 10 Hz on an absolute schedule, *velocity* answers with VEL, *base*
subscribes to VEL, and *pc* to both. Each system has the same four hosts and the same nodes; with classic ROS the pc
runs the one roscore, with RMPA each host has its agent: *RMPA* is through these, *RMPA direct* from node to node.
What is measured, all at the pc:

* the **period** of CMD and of VEL: the time between two messages that follow each other;
* the **control computation delay**: when VEL came less when the CMD with the same number came.

The velocity node is *polled* at 10 Hz as the paper's was (it sends at its next tick, if a new command is there) or
*event-driven* (it answers at once). When polled, the delay is the time from the command to the next tick, so it is
decided by how the two schedules happen to lie. All are given the same phases here, a new one each round:
the joystick's schedule begins at a stated time (`phase_ms`) after a tick of the velocity node.

Classic ROS runs with tcp_nodelay, its best setting. Beside it stand one round without it, and, with the
event-driven node, three rounds with as many processes between as RMPA has: a relay in C++ at both ends of each
flow. Systems take turns; standard deviations are taken for each round, ratios over neighbouring rounds.
"""

_NOTES: Final = (
    (
        "Relayed by RMPA, each message wakes two processes more than with classic ROS. At 10 Hz each is woken from "
        "an idle processor and finds cold caches, which costs several times what it does at 1 kHz, most of all on a "
        "virtual machine. Where relays in C++ stand beside it, they have what two more processes cost by "
        "themselves."
    ),
    (
        "With the polled velocity node the delay is the time until its next tick, and chance decides it: any "
        "value up to one period of 100 ms, and the time on the way, is as likely as any other, on either system. "
        "The paper's 61.3 ms and 103.8 ms are two such values, and say nothing of either system. With the same "
        "phases both have the same delay."
    ),
    (
        "When polled, VEL leaves by the velocity node's own schedule: its period at the pc has that node's jitter "
        "and one hop's, and none of CMD's."
    ),
)


class Control:
    """Experiment 1."""

    name = "control"
    title = "1. Rates and control computation delay (Figs. 8 and 9, Table 1)"
    about = _ABOUT

    def cells(self, plan: Plan) -> list[Cell]:
        """One for each client, mode, contender and round; the short form has one client's only."""
        seconds = _SETUP + _MESSAGES[plan.size] / RATE
        clients = plan.clients[:1] if plan.short else plan.clients
        given = phases(plan.seed, _ROUNDS[plan.size])
        made: list[Cell] = []
        for number, phase in enumerate(given, 1):
            for (client, mode), shift in zip(itertools.product(clients, MODES), itertools.count(number)):
                beside = [] if plan.short else _beside(mode, number)
                for contender in (*turn(COMPARED, shift), *beside):
                    settings: dict[str, Value] = {**contender.settings, "client": client, "mode": mode}
                    if mode == "polled":
                        settings["phase_ms"] = phase
                    made.append(Cell(self.name, {**settings, "round": number}, seconds))
        return made

    def measure(self, cell: Cell, stage: Stage) -> Measured:
        """Measure one round of one contender.

        Raises:
            BedError: A node or the system did not do what it should.
        """
        client, nodelay = cast("Client", cell.settings["client"]), nodelay_of(cell)
        mode = str(cell.settings["mode"])
        phase = cell.settings.get("phase_ms")  # an event-driven node has no schedule of its own
        relayed = relays_of(cell) > 0
        way = transport_of(cell)
        with stage.system(system_of(cell), HOSTS, way=way) as system:
            if relayed:
                _start_relays(system)
            at = _at if relayed else _direct
            base = system.node("base", "sink", client, topics=at(VEL, "base"), nodelay=nodelay)
            pc = system.node("pc", "sink", client, topics=f"{at(CMD, 'pc')},{at(VEL, 'pc')}", nodelay=nodelay)
            cmd = at(CMD, "velocity")
            velocity = system.node(
                "velocity", "velocity", client, cmd=cmd, vel=VEL, mode=mode, rate=RATE, nodelay=nodelay
            )
            source = system.node("joystick", "source", client, topic=CMD, phase=phase)
            pairs = [(source, velocity), (source, pc), (velocity, base), (velocity, pc)]
            system.require_transport(pairs)
            # An agent or a relay is the one local subscriber, however many are behind it.
            subscribers = 1 if relayed or (system.kind == "rmpa" and way == "relay") else 2
            flow.wait_connected(source, subscribers)
            flow.wait_connected(velocity, subscribers)
            flow.wait_flowing(source, base, (VEL,), stage.scratch, least=1)
            flow.wait_flowing(source, pc, (CMD, VEL), stage.scratch, least=1)
            begun = flow.begin(source, stage.scratch, size=_SIZE, rate=RATE, count=_LEAD + _MESSAGES[stage.plan.size])
            sent = flow.sent(begun)
            system.require_transport(pairs)
            tables = {
                "pc": flow.noted(pc, (CMD, VEL), stage.scratch, begun.number),
                "base": flow.noted(base, (VEL,), stage.scratch, begun.number),
                "sent": sent,
            }
        return Measured({title: counting_from(table, _LEAD) for title, table in tables.items()})

    def findings(self, results: Results) -> Findings:
        """Table 1, Figs. 8 and 9 for each client and mode, and what should hold."""
        figures: list[Figure] = []
        grids: list[Grid] = []
        claims: list[Claim] = []
        for client, mode in _measured(results):
            ways = {
                contender: rounds(results, contender, client, mode)
                for contender in (RMPA, DIRECT, CLASSIC, RELAYS, DEFAULTS)
            }
            figures.append(_figure(ways, client, mode))
            grids.append(_grid(ways, client, mode))
            for contender in _DELAY_LIMITS_MS:
                if ways[contender]:
                    claims.extend(_claims(ways, contender, client, mode))
        return Findings(tuple(figures), tuple(grids), tuple(claims), _NOTES if figures else ())


EXPERIMENT: Final = Control()


def _direct(topic: str, _host: str) -> str:
    """The topic that a subscriber on a host takes: the publisher's own."""
    return topic


def _at(topic: str, host: str) -> str:
    """The same where a relay on the subscriber's host passes it on."""
    return f"{topic}_{host}"


def _start_relays(system: System) -> None:
    """One at each end of each flow, so that each message passes as many processes as with agents."""

    def relay(host: str, begin: str, end: str) -> None:
        system.node(host, "velocity", "roscpp", cmd=begin, vel=end, mode="event", nodelay=True)

    for topic, (origin, *ends) in _FLOWS.items():
        out = f"{topic}_out"
        relay(origin, topic, out)
        for host in ends:
            relay(host, out, _at(topic, host))


def _beside(mode: str, number: int) -> list[Contender]:
    """What else is measured in a round; relays only where the delay is theirs, and not the next tick's."""
    made = [DEFAULTS] if number <= _DEFAULTS_ROUNDS else []
    return [*made, RELAYS] if mode == "event" and number <= _RELAYS_ROUNDS else made


def phases(seed: int, count: int) -> list[float]:
    """Where the joystick's schedule begins after a tick of the velocity node, ms, for each round.

    One from each of ``count`` equal parts of the period, in an order by chance, so that few rounds cover it evenly.
    """
    chance = random.Random(seed)
    width = (1e3 / RATE - 2 * _MARGIN_MS) / count
    parts = [round(_MARGIN_MS + width * (part + chance.random()), 1) for part in range(count)]
    chance.shuffle(parts)
    return parts


@dataclass(frozen=True, slots=True)
class ControlRound:
    """What one round of one contender showed; seconds.

    Args:
        cmd: Periods of CMD at the pc.
        vel: Periods of VEL at the pc.
        base: Periods of VEL at the base.
        source: Periods at which CMD was published.
        delay: The control computation delay, message by message.
    """

    cmd: list[float]
    vel: list[float]
    base: list[float]
    source: list[float]
    delay: list[float]

    def mean(self, quantity: str) -> float | None:
        """Of one of them, by its name."""
        return statistics.spread(getattr(self, quantity)).mean

    def sd(self, quantity: str) -> float | None:
        """Likewise."""
        return statistics.spread(getattr(self, quantity)).sd


def evaluate(measured: Measured) -> ControlRound:
    """Read one round's tables."""
    pc, base, sent = (measured.tables[name] for name in ("pc", "base", "sent"))
    cmd, vel = pairs(pc, topic=CMD), pairs(pc, topic=VEL)
    return ControlRound(
        cmd=statistics.periods(cmd),
        vel=statistics.periods(vel),
        base=statistics.periods(pairs(base, topic=VEL)),
        source=source_periods(sent, RATE),
        delay=[seconds for _, seconds in statistics.delays(cmd, vel)],
    )


def rounds(results: Results, contender: Contender, client: str, mode: str) -> dict[int, ControlRound]:
    """What was measured of one contender, by the round's number."""
    found = contender.select(results, client=client, mode=mode)
    return {
        number: evaluate(measured) for cell, measured in found if isinstance(number := cell.settings["round"], int)
    }


Ways = dict["Contender", dict[int, ControlRound]]


def _measured(results: Results) -> Iterator[tuple[str, str]]:
    """Pairs of client and mode of which there is anything, in the plan's order."""
    for client, mode in itertools.product(results.plan.clients, MODES):
        if any(True for _ in results.select(client=client, mode=mode)):
            yield client, mode


def _paired(
    ways: Ways, figure: Callable[[ControlRound], float | None], one: Contender = RMPA, base: Contender = CLASSIC
) -> tuple[list[float | None], list[float | None]]:
    """One figure of two contenders, of the rounds that both have."""
    ours, theirs = ways[one], ways[base]
    common = sorted(ours.keys() & theirs.keys())
    return [figure(ours[number]) for number in common], [figure(theirs[number]) for number in common]


def _claims(ways: Ways, contender: Contender, client: str, mode: str) -> Iterator[Claim]:
    label, ours_is_papers = contender.label, contender == RMPA and mode == "polled"
    for quantity in ("cmd", "vel"):
        _, _, ours, theirs = _PAPER[quantity]
        yield Claim(
            f"period sd of {quantity.upper()} at the pc, {mode}, {client}: {label} / classic",
            _ratio(*_paired(ways, functools.partial(ControlRound.sd, quantity=quantity), contender)),
            _JITTER_LIMIT,
            paper=round(ours / theirs, 2) if ours_is_papers else None,
        )
    means = _paired(ways, lambda one: one.mean("delay"), contender)
    if mode == "polled":
        ours, theirs, _, _ = _PAPER["delay"]
        text = f"mean control delay, polled, same phases, {client}: {label} / classic"
        paper = round(ours / theirs, 2) if ours_is_papers else None
        yield Claim(text, _ratio(*means), _POLLED_LIMIT, paper=paper)
        return
    more = [1e3 * (a - b) for a, b in zip(*means, strict=True) if a is not None and b is not None]
    value = statistics.median(more) if len(more) >= _ROUNDS_NEEDED else None
    text = f"mean control delay, event, {client}: {label} less classic"
    yield Claim(text, value, _DELAY_LIMITS_MS[contender], unit="ms")
    if contender == DIRECT:
        return
    relayed = _ratio(*_paired(ways, lambda one: one.mean("delay"), base=RELAYS))
    yield Claim(f"mean control delay, event, {client}: RMPA / classic through relays in C++", relayed, _RELAYS_LIMIT)


def _ratio(ours: Sequence[float | None], theirs: Sequence[float | None]) -> float | None:
    found = statistics.ratio(ours, theirs)
    return found.value if found and found.rounds >= _ROUNDS_NEEDED else None


def _grid(ways: Ways, client: str, mode: str) -> Grid:
    shown = [contender for contender in ways if ways[contender]]
    ours = [contender for contender in (RMPA, DIRECT) if contender in shown] or [RMPA]
    rows: list[tuple[str, ...]] = []
    for quantity, title in [
        ("source", "Command Order, as it is sent"),
        *_QUANTITIES.items(),
        ("base", "Velocity Order, at the base"),
    ]:
        row = [title]
        for figure in (ControlRound.mean, ControlRound.sd):
            row += [_of(ways[contender], figure, quantity) for contender in shown]
        rows.append((*row, *(_ratio_text(ways, quantity, one) for one in ours)))
        if mode == "polled" and quantity in _PAPER:
            rows.append((*_paper_row(quantity, shown), *[""] * (len(ours) - 1)))
    heads = [f"{what}, {contender.label}" for what in ("mean", "sd") for contender in shown]
    return Grid(
        f"Table 1. {client}, {_NODES[mode]}; periods and delay, ms",
        ("at the pc", *heads, *(f"sd, {one.label} / classic" for one in ours)),
        rows,
        "Medians over rounds; the ratio is of neighbouring rounds, in brackets its 95 % interval over them.",
    )


def _of(found: dict[int, ControlRound], figure: Callable[[ControlRound, str], float | None], quantity: str) -> str:
    return counted(statistics.median(figure(one, quantity) for one in found.values()), _DIGITS, 1e3)


def _ratio_text(ways: Ways, quantity: str, contender: Contender) -> str:
    found = statistics.ratio(*_paired(ways, lambda one: one.sd(quantity), contender))
    return "-" if found is None else str(found)


def _paper_row(quantity: str, shown: Sequence[Contender]) -> tuple[str, ...]:
    mean_ours, mean_theirs, sd_ours, sd_theirs = (1e3 * value for value in _PAPER[quantity])
    means = {RMPA: counted(mean_ours, _DIGITS), CLASSIC: counted(mean_theirs, _DIGITS)}
    deviations = {RMPA: counted(sd_ours, _DIGITS), CLASSIC: counted(sd_theirs, _DIGITS)}
    columns = [of.get(contender, "") for of in (means, deviations) for contender in shown]
    return (f"{_QUANTITIES[quantity]}, in the paper", *columns, f"{sd_ours / sd_theirs:.3g}")


def _figure(ways: Ways, client: str, mode: str) -> Figure:
    panels = [
        Panel(
            title,
            "message",
            "delay, ms" if quantity == "delay" else "period, ms",
            tuple(
                Series(f"{contender.label}, {client}", *_numbered(ways[contender], quantity), system=contender.look)
                for contender in COMPARED
                if ways[contender]
            ),
            distribution=True,
        )
        for quantity, title in _QUANTITIES.items()
    ]
    caption = "Message by message as in the paper, which has a figure for each system; one round after the other."
    if mode == "polled":
        caption += " The steps of the delay are the phases that all systems were given."
    return Figure(
        f"fig-8-9-{client}-{mode}",
        f"Figs. 8 and 9. Periods and control computation delay: {client}, {_NODES[mode]}",
        caption,
        tuple(panels),
        columns=3,
    )


def _numbered(found: dict[int, ControlRound], quantity: str) -> tuple[list[float], list[float]]:
    values = [1e3 * value for number in sorted(found) for value in getattr(found[number], quantity)]
    return [float(number) for number in range(1, len(values) + 1)], values
