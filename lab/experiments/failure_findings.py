"""Findings of experiment 4: losses and outages of each flow, the timeline, and the claims."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from lab.experiments.contenders import COMPARED, DIRECT, RMPA, Contender, contender_of
from lab.findings import Claim, Figure, Findings, Grid, Panel, Series
from lab.statistics import flowing, outages

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from lab.experiments.model import Cell, Measured, Results

# Messages a second of each source.
RATE: Final = 50.0
# Seconds without a message that are an outage: ten messages.
_STILL: Final = 0.2
# Seconds before the end in which messages that are not there yet are not counted as lost.
_ON_THE_WAY: Final = 0.3
# Seconds from due to there beyond which a message that came is late.
_LATE: Final = 0.1
_AGAIN_WITHIN: Final = 1.0


@dataclass(frozen=True, slots=True)
class Flow:
    """One topic at one receiver.

    Args:
        key: Its name in tables.
        title: Its name in the report.
        sink: The node that notes it.
        topic: Which of that node's.
        hosts: Those that it needs.
    """

    key: str
    title: str
    sink: str
    topic: str
    hosts: frozenset[str]


FLOWS: Final = (
    Flow("cmd-velocity", "CMD, joystick → velocity", "log", "/cmd", frozenset({"joystick", "velocity"})),
    Flow("cmd-pc", "CMD, joystick → pc", "display", "/cmd", frozenset({"joystick", "pc"})),
    Flow("vel-base", "VEL, velocity → base", "wheels", "/vel", frozenset({"joystick", "velocity", "base"})),
    Flow("vel-pc", "VEL, velocity → pc", "display", "/vel", frozenset({"joystick", "velocity", "pc"})),
    Flow("state-joystick", "STATE, base → joystick", "lamp", "/state", frozenset({"base", "joystick"})),
)


@dataclass(frozen=True, slots=True)
class Scenario:
    """What happens.

    Args:
        title: In words.
        host: To which host.
        node: The flow whose receiving node crashes meanwhile and is started again, if one is.
    """

    title: str
    host: str
    node: str = ""

    def touches(self, flow: Flow) -> bool:
        """Whether what happens is done to one of the flow's own hosts or nodes."""
        return self.host in flow.hosts or flow.key == self.node


SCENARIOS: Final[Mapping[str, Scenario]] = {
    "master": Scenario("pc (classic: with the master) killed; a node of base crashes meanwhile", "pc", "vel-base"),
    "host": Scenario("velocity killed", "velocity"),
    "cable": Scenario("velocity's cable out for 3 s", "velocity"),
    "cable-long": Scenario("velocity's cable out for 5 s", "velocity"),
}
_WORDS: Final = {
    "down": "down",
    "node": "node of base crashes",
    "on": "on again",
    "on up": "its nodes up",
    "end": "end",
    "by hand": "by hand",
}


@dataclass(frozen=True, slots=True)
class FlowLosses:
    """Losses and outage of one flow between the failure and the end of the observation.

    Args:
        flow: Which.
        touched: Whether it was done to one of its own hosts or nodes.
        due: Messages that should have come.
        lost: Of these never came.
        late: Of these came more than 0.1 s after they were due.
        outage: Seconds of the longest time without a message; 0 if none was longer than 0.2 s.
        back: Whether it ran at the end.
        after_start: Seconds from the start of what was started again (the agent or master, a node; the cable) until
            it ran again; ``None`` if it never stood still, or never came back.
        after_up: Seconds from the moment at which all of that was up.
        by_hand: Whether it ran after all nodes had been started again by hand; ``None`` if they were not.
    """

    flow: Flow
    touched: bool
    due: int
    lost: int
    late: int
    outage: float
    back: bool
    after_start: float | None = None
    after_up: float | None = None
    by_hand: bool | None = None


def outcomes(cell: Cell, measured: Measured) -> list[FlowLosses]:
    """Losses and outages of each flow in one cell."""
    scenario = SCENARIOS[str(cell.settings["scenario"])]
    moments = _moments(measured)
    return [_outcome(flow, scenario, rows, moments) for flow, rows in _rows(measured).items()]


def _outcome(
    flow: Flow, scenario: Scenario, rows: Sequence[tuple[int, int, int]], moments: Mapping[str, int]
) -> FlowLosses:
    """Rows are (sequence, due, came)."""
    down, end = moments["down"], moments["end"]
    counted = _ns(_ON_THE_WAY)
    within = {sequence: came - due for sequence, due, came in reversed(rows) if down <= due < end - counted}
    due = _due(rows, down, end - counted)
    still = outages([(sequence, came) for sequence, _, came in rows if down <= came <= end], _STILL, (down, end))
    start, up = ("node", "node up") if flow.key == scenario.node else ("on", "on up")
    ran = min((came for _, _, came in rows if moments.get(start, end) <= came <= end), default=None)
    back = not (still and not still[-1].back)
    again = ran if still and back and scenario.touches(flow) else None
    hand = moments.get("by hand")
    return FlowLosses(
        flow,
        scenario.touches(flow),
        due,
        max(0, due - len(within)),
        sum(late > _ns(_LATE) for late in within.values()),
        max((one.seconds for one in still), default=0.0),
        back,
        None if again is None else (again - moments[start]) / 1e9,
        None if again is None or up not in moments else max(0.0, (again - moments[up]) / 1e9),
        None if hand is None else any(came > hand for _, due, came in rows if due > hand),
    )


def _due(rows: Sequence[tuple[int, int, int]], begin: int, end: int) -> int:
    """How many messages were due between two moments, by the schedule that any of those that came tells."""
    if not rows:
        return max(0, round((end - begin) / _ns(1 / RATE)))
    sequence, due, _ = rows[0]
    zero = due - _ns(sequence / RATE)
    first, last = (-(-(at - zero) // _ns(1 / RATE)) for at in (begin, end))
    return int(last - max(0, first))


def _rows(measured: Measured) -> dict[Flow, list[tuple[int, int, int]]]:
    by_key: dict[str, list[tuple[int, int, int]]] = {flow.key: [] for flow in FLOWS}
    for key, sequence, due, came in measured.tables["flows"].itertuples(index=False, name=None):
        by_key[str(key)].append((_int(sequence), _int(due), _int(came)))
    return {flow: by_key[flow.key] for flow in FLOWS}


def _moments(measured: Measured) -> dict[str, int]:
    return {str(what): _int(at) for what, at in measured.tables["moments"].itertuples(index=False, name=None)}


def _int(value: object) -> int:
    return int(str(value))


def _ns(seconds: float) -> int:
    return int(seconds * 1e9)


# --- what is said of it -------------------------------------------------------------------------------------------


def findings(results: Results) -> Findings:
    """The timelines, the table and the claims."""
    told = [(cell, measured, outcomes(cell, measured)) for cell, measured in results.cells]
    if not told:
        return Findings()
    return Findings(
        figures=tuple(_figures(results)),
        grids=(_grid([(cell, found) for cell, _, found in told]),),
        claims=tuple(_claims([(cell, found) for cell, _, found in told])),
        notes=tuple(_notes(told)),
    )


def _figures(results: Results) -> Iterable[Figure]:
    """One for each scenario and client: the systems below each other, on the same rows."""
    seen = dict.fromkeys((cell.settings["scenario"], cell.settings["client"]) for cell, _ in results.cells)
    for scenario, client in seen:
        panels = [
            _timeline(contender, str(client), measured)
            for contender in COMPARED
            for cell, measured in results.select(client=client, scenario=scenario)
            if contender_of(cell) == contender
        ]
        yield Figure(
            f"failure-{scenario}-{client}",
            f"{SCENARIOS[str(scenario)].title} ({client})",
            "Each bar is a flow while messages come; a hole is a time without any.",
            tuple(panels),
            columns=1,
        )


def _timeline(contender: Contender, client: str, measured: Measured) -> Panel:
    moments = _moments(measured)
    zero = moments["down"]
    x: list[float] = []
    y: list[float] = []
    for row, rows in enumerate(_rows(measured).values()):
        for begin, end in flowing([(sequence, came) for sequence, _, came in rows], _STILL):
            x += [(begin - zero) / 1e9, (end - zero) / 1e9]
            y += [row, row]
    return Panel(
        f"{contender.label}, {client}",
        "since the failure, s",
        "",
        (Series(contender.label, x, y, "spans", contender.look),),
        moments={_WORDS[what]: (at - zero) / 1e9 for what, at in moments.items() if what in _WORDS},
        names=tuple(flow.title for flow in FLOWS),
    )


def _grid(told: Sequence[tuple[Cell, list[FlowLosses]]]) -> Grid:
    heads = ("what happens", "nodes", "flow", "system", "due", "lost", "late", "longest outage, s", "runs again")
    rows = [
        (
            SCENARIOS[str(cell.settings["scenario"])].title,
            str(cell.settings["client"]),
            outcome.flow.title + (" *" if outcome.touched else ""),
            contender_of(cell).label,
            str(outcome.due),
            str(outcome.lost),
            str(outcome.late),
            f"{outcome.outage:.2f}" if outcome.outage else "-",
            _again(outcome),
        )
        for cell, found in told
        for outcome in found
    ]
    note = (
        "* needs the host that fails, or the node that crashes. Runs again: seconds from the start of what was"
        " started again (agent or master, node; the cable), and in brackets from when all of that was up. Late:"
        " more than 0.1 s. By hand: after every node that ran since before the failure was started again."
    )
    return Grid("What became of each flow", heads, rows, note)


def _again(outcome: FlowLosses) -> str:
    if not outcome.back:
        return "never; by hand" if outcome.by_hand else "never" if outcome.by_hand is None else "never, nor by hand"
    if outcome.after_start is None:
        return "ran on" if not outcome.outage else "yes"
    up = "" if outcome.after_up is None else f" ({outcome.after_up:.2f})"
    return f"{outcome.after_start:.2f}{up}"


def _claims(told: Sequence[tuple[Cell, list[FlowLosses]]]) -> Iterable[Claim]:
    classic = [
        sum(not outcome.back for outcome in found)
        for cell, found in told
        if (cell.settings["system"], cell.settings["scenario"]) == ("classic", "master")
    ]
    text = "classic, the master's host killed and on again: flows that do not come back by themselves"
    yield Claim(text, min(classic, default=None), 1, at_least=True)
    for contender in (RMPA, DIRECT):
        ours = [(str(cell.settings["scenario"]), found) for cell, found in told if contender_of(cell) == contender]
        if ours or contender == RMPA:
            yield from _our_claims(contender.label, ours)


def _our_claims(label: str, ours: Sequence[tuple[str, list[FlowLosses]]]) -> Iterable[Claim]:
    """Of RMPA by one transport, from losses by scenario."""
    never = [sum(not outcome.back for outcome in found) for _, found in ours]
    yield Claim(f"{label}, any failure: flows that do not come back by themselves", max(never, default=None), 0)
    lost = [sum(outcome.lost for outcome in found if not outcome.touched) for _, found in ours]
    yield Claim(f"{label}, any failure: messages lost on flows of other hosts", max(lost, default=None), 0)
    ups, cables = (
        [
            outcome.after_up
            for scenario, found in ours
            for outcome in found
            if outcome.after_up is not None and scenario.startswith("cable") == cable
        ]
        for cable in (False, True)
    )
    text = f"{label}: flows run again, from when the agent is ready and the node up, worst"
    yield Claim(text, max(ups, default=None), _AGAIN_WITHIN, unit="s")
    if cables:
        text = f"{label}: flows run again, from when the cable is in again, worst"
        yield Claim(text, max(cables), _AGAIN_WITHIN, unit="s")


def _notes(told: Sequence[tuple[Cell, Measured, list[FlowLosses]]]) -> Iterable[str]:
    ours = [(cell, outcome) for cell, _, found in told for outcome in found if cell.settings["system"] == "rmpa"]
    starts = [
        outcome.after_start
        for cell, outcome in ours
        if outcome.after_start is not None and cell.settings["scenario"] in {"master", "host"}
    ]
    if starts:
        yield (
            "The second after the restart counts from when the agent is ready and its host's nodes said that they"
            " are up: how long programs take to be loaded is not the architecture's. From the execution of the"
            f" agent, with all of that in it, the worst flow took {max(starts):.2f} s."
        )
    if direct := [measured.facts for cell, measured, _ in told if contender_of(cell) == DIRECT]:
        again, all_of_them = (sum(_int(facts[name]) for facts in direct) for name in ("direct", "connections"))
        yield (
            f"RMPA direct: at the end of the observations {again} of {all_of_them} connections between hosts were"
            " from node to node again; the others, if any, were relayed or not yet there."
        )
    for cell, measured, found in told:
        if (by_hand := measured.facts.get("by_hand")) and cell.settings["system"] == "classic":
            never = sum(not outcome.back for outcome in found)
            yield (
                f"Classic, {cell.settings['client']}, {SCENARIOS[str(cell.settings['scenario'])].title}:"
                " connections that existed went on without the master. A node that is started while it is away"
                " waits for it; the master that came back knows nothing of the nodes that had run on, so nobody"
                f" that is new finds them: {never} flows needed {by_hand} nodes of other hosts to be started again"
                " by hand."
            )
    if any(str(cell.settings["scenario"]).startswith("cable") for cell, _, _ in told):
        yield (
            "With the cable out, classic ROS's connections live on: TCP tries again 0.2, 0.6, 1.4, 3, 6.2 s after"
            " it went, so it depends on the moment how soon they run again, and what had been queued comes late"
            " and in a burst. RMPA's links end after a second and are made anew; what was due meanwhile is not"
            " kept."
        )
