"""Experiment 4: what is planned, and what follows from samples whose answers are known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.plan import Plan
from lab.experiments.failure import EXPERIMENT
from lab.experiments.failure_findings import FLOWS, RATE, FlowLosses, outcomes
from lab.experiments.model import Cell, Measured, Results, Value
from lab.frames import frame

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lab.findings import Claim, Findings

STEP = int(1e9 / RATE)
DOWN, END = 100 * STEP, 600 * STEP
COUNTED = range(100, 585)
"""Numbers of the messages that count: due from the failure until 0.3 s before the end."""


def run(*without: tuple[str, range]) -> list[tuple[Value, ...]]:
    """Rows of all flows, each message 1 ms on its way, but for those of some flows."""
    return [
        (flow.key, number, number * STEP, number * STEP + 1_000_000)
        for number in range(600)
        for flow in FLOWS
        if not any(key == flow.key and number in lost for key, lost in without)
    ]


def measured(rows: Sequence[tuple[Value, ...]], restarted: int = 0, **moments: int) -> Measured:
    told = {"down": DOWN, "end": END, **{name.replace("_", " "): at for name, at in moments.items()}}
    tables = {
        "flows": frame(("flow", "sequence", "due_ns", "came_ns"), rows),
        "moments": frame(("what", "at_ns"), list(told.items())),
    }
    return Measured(tables, {"by_hand": restarted, "rate": RATE})


def cell(scenario: str, system: str = "rmpa", client: str = "roscpp", **more: Value) -> Cell:
    return Cell("failure", {"system": system, **more, "client": client, "scenario": scenario, "round": 1})


def outcome_of(key: str, found: list[FlowLosses]) -> FlowLosses:
    return next(one for one in found if one.flow.key == key)


def claims(*cells: tuple[Cell, Measured]) -> dict[str, Claim]:
    found: Findings = EXPERIMENT.findings(Results(Plan(), cells))
    return {claim.text: claim for claim in found.claims}


def test_a_flow_that_nothing_happens_to_loses_nothing() -> None:
    found = outcomes(cell("host"), measured(run(), on=300 * STEP, on_up=310 * STEP))
    assert [(one.due, one.lost, one.late, one.outage, one.back) for one in found] == [
        (len(COUNTED), 0, 0, 0.0, True)
    ] * 5
    assert [one.touched for one in found] == [True, False, True, True, False]
    assert all(one.after_start is None for one in found)


def test_messages_due_while_a_host_was_away_are_lost() -> None:
    rows = run(("cmd-velocity", range(100, 320)))
    found = outcome_of("cmd-velocity", outcomes(cell("host"), measured(rows, on=300 * STEP, on_up=315 * STEP)))
    assert found.lost == 220
    assert found.back
    assert found.after_start == pytest.approx(20 / RATE + 0.001)
    assert found.after_up == pytest.approx(5 / RATE + 0.001)
    assert found.outage == pytest.approx(220 / RATE, abs=2 / RATE)


def test_messages_before_the_failure_and_of_the_last_moment_do_not_count() -> None:
    rows = run(("cmd-pc", range(100)), ("vel-pc", range(585, 600)))
    found = outcomes(cell("host"), measured(rows))
    assert outcome_of("cmd-pc", found).lost == 0
    assert outcome_of("vel-pc", found).lost == 0


def test_what_comes_late_is_late_and_not_lost() -> None:
    rows = [
        (key, number, due, 250 * STEP if key == "vel-base" and due in range(200 * STEP, 250 * STEP) else came)
        for key, number, due, came in run()
        if isinstance(due, int)
    ]
    found = outcome_of("vel-base", outcomes(cell("cable"), measured(rows, on=240 * STEP, on_up=240 * STEP)))
    assert (found.lost, found.late) == (0, 45)  # those due more than 0.1 s before
    assert found.outage == pytest.approx(51 / RATE, abs=0.002)
    assert found.after_start == pytest.approx(10 / RATE)


def test_one_that_never_comes_back_is_told_and_what_hands_did() -> None:
    rows = run(("vel-base", range(100, 600)))
    rows += [("vel-base", number, END + number * STEP, END + number * STEP) for number in range(1, 9)]
    found = outcome_of(
        "vel-base", outcomes(cell("master", "classic"), measured(rows, 5, node=150 * STEP, by_hand=END))
    )
    assert not found.back
    assert found.lost == len(COUNTED)
    assert found.after_start is None
    assert found.by_hand is True


def test_a_node_that_crashed_is_measured_from_its_own_start() -> None:
    rows = run(("vel-base", range(150, 200)))
    found = outcomes(
        cell("master"), measured(rows, node=150 * STEP, node_up=180 * STEP, on=300 * STEP, on_up=300 * STEP)
    )
    crashed = outcome_of("vel-base", found)
    assert crashed.touched
    assert crashed.after_start == pytest.approx(1.001)
    assert crashed.after_up == pytest.approx(0.401)


def test_the_claims_say_what_classic_lost_and_rmpa_kept() -> None:
    dead = [("cmd-pc", range(100, 600)), ("vel-pc", range(100, 600)), ("vel-base", range(150, 600))]
    classic = measured(run(*dead), 5, node=150 * STEP, on=300 * STEP, on_up=310 * STEP, by_hand=END)
    short = [("cmd-pc", range(100, 320)), ("vel-pc", range(100, 320))]
    ours = measured(run(*short), node=150 * STEP, node_up=160 * STEP, on=300 * STEP, on_up=310 * STEP)
    found = claims((cell("master", "classic"), classic), (cell("master"), ours))
    values = [claim.value for claim in found.values()]
    assert values == [3, 0, 0, pytest.approx(0.201)]
    assert all(claim.reached for claim in found.values())


def test_a_message_lost_elsewhere_breaks_the_claim() -> None:
    ours = measured(run(("state-joystick", range(200, 203))), on=300 * STEP, on_up=310 * STEP)
    found = claims((cell("host"), ours))["RMPA, any failure: messages lost on flows of other hosts"]
    assert (found.value, found.reached) == (3, False)
