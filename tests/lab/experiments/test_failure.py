"""Experiment 4: what is planned, and what follows from samples whose answers are known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.plan import Plan
from lab.experiments.failure import EXPERIMENT, NODES
from lab.experiments.failure_findings import FLOWS, RATE, SCENARIOS, FlowLosses, outcomes
from lab.experiments.model import Cell, Measured, Results, Value
from lab.findings import Claim, Findings
from lab.frames import frame

if TYPE_CHECKING:
    from collections.abc import Sequence

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


def test_each_flow_is_noted_by_a_node_that_there_is() -> None:
    topics = {node.name: str(node.options.get("topics")).split(",") for node in NODES if node.program == "sink"}
    assert {(flow.sink, flow.topic) for flow in FLOWS} == {(name, one) for name, of in topics.items() for one in of}


def test_both_systems_take_turns_and_without_cables_none_is_cut() -> None:
    settings = [one.settings for one in EXPERIMENT.cells(Plan())]
    turns = [("classic", None), ("rmpa", None), ("rmpa", "direct")]
    assert [(one["system"], one.get("transport")) for one in settings] == turns * (len(settings) // 3)
    assert {one["scenario"] for one in settings} == set(SCENARIOS)
    loopback = EXPERIMENT.cells(Plan(bed="loopback", clients=("own",), link=""))
    assert {one.settings["scenario"] for one in loopback} == {"master", "host"}


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


def test_a_flow_without_a_single_message_lost_all() -> None:
    found = outcome_of("vel-pc", outcomes(cell("master"), measured(run(("vel-pc", range(600))))))
    assert (found.lost, found.back) == (found.due, False)
    assert found.due == pytest.approx(len(COUNTED), abs=1)


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


def test_the_direct_transport_has_claims_and_a_timeline_of_its_own() -> None:
    lost = measured(run(("state-joystick", range(200, 203))), on=300 * STEP, on_up=310 * STEP)
    told = Measured(lost.tables, {**lost.facts, "direct": 5, "connections": 6})
    kept = measured(run(), on=300 * STEP, on_up=310 * STEP)
    found = EXPERIMENT.findings(Results(Plan(), [(cell("host"), kept), (cell("host", transport="direct"), told)]))
    values = {claim.text: claim.value for claim in found.claims}
    assert values["RMPA, any failure: messages lost on flows of other hosts"] == 0
    assert values["RMPA direct, any failure: messages lost on flows of other hosts"] == 3
    assert [panel.series[0].system for panel in found.figures[0].panels] == ["rmpa", "direct"]
    assert any("5 of 6 connections between hosts" in note for note in found.notes)


def test_of_our_own_nodes_classic_ros_is_not_judged() -> None:
    dead = measured(run(("cmd-pc", range(100, 600))), on=300 * STEP)
    found = claims((cell("master", "classic", "own"), dead))
    assert next(iter(found.values())).value is None


def test_the_timeline_has_a_bar_for_each_time_without_a_hole() -> None:
    rows = run(("cmd-velocity", range(100, 320)))
    told = measured(rows, on=300 * STEP, on_up=310 * STEP)
    figure = EXPERIMENT.findings(Results(Plan(), [(cell("host"), told)])).figures[0]
    bars = figure.panels[0].series[0]
    assert list(bars.y).count(0) == 4  # two bars, each with its two ends
    assert list(bars.y).count(1) == 2
    assert figure.panels[0].moments["on again"] == pytest.approx(200 / RATE)
    assert len(figure.panels[0].names) == len(FLOWS)


def test_without_any_cell_nothing_is_said() -> None:
    assert EXPERIMENT.findings(Results(Plan(), [])) == Findings()
