"""Experiment 4: what is planned, and what follows from samples whose answers are known."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab.bed.plan import Plan
from lab.experiments.failure import EXPERIMENT
from lab.experiments.failure_findings import FLOWS, RATE
from lab.experiments.model import Cell, Measured, Results, Value
from lab.frames import frame

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lab.findings import Claim, Findings

STEP = int(1e9 / RATE)
DOWN, END = 100 * STEP, 600 * STEP


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


def claims(*cells: tuple[Cell, Measured]) -> dict[str, Claim]:
    found: Findings = EXPERIMENT.findings(Results(Plan(), cells))
    return {claim.text: claim for claim in found.claims}


def test_the_claims_say_what_classic_lost_and_rmpa_kept() -> None:
    dead = [("cmd-pc", range(100, 600)), ("vel-pc", range(100, 600)), ("vel-base", range(150, 600))]
    classic = measured(run(*dead), 5, node=150 * STEP, on=300 * STEP, on_up=310 * STEP, by_hand=END)
    short = [("cmd-pc", range(100, 320)), ("vel-pc", range(100, 320))]
    ours = measured(run(*short), node=150 * STEP, node_up=160 * STEP, on=300 * STEP, on_up=310 * STEP)
    found = claims((cell("master", "classic"), classic), (cell("master"), ours))
    values = [claim.value for claim in found.values()]
    assert values == [3, 0, 0, pytest.approx(0.201)]
    assert all(claim.reached for claim in found.values())
