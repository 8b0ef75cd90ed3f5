"""Rounds made by hand: every other message comes late by a stated time, so that each standard deviation is known."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import pytest

from lab.bed.plan import Plan
from lab.experiments.contenders import DIRECT, contender_of
from lab.experiments.control import CMD, EXPERIMENT, VEL, evaluate
from lab.experiments.model import Cell, Measured, Results
from lab.frames import frame

if TYPE_CHECKING:
    from collections.abc import Callable

    from lab.findings import Claim

MS = 1_000_000
PERIOD = 100 * MS
COLUMNS = ("topic", "sequence", "due_ns", "came_ns")
FULL = Plan(clients=("roscpp",))


def made(cmd_ms: float, vel_ms: float, delay_ms: float, *, hop_ms: float = 0.25, count: int = 101) -> Measured:
    """Every other CMD comes ``cmd_ms`` later and every other VEL ``vel_ms``; the others are ``delay_ms`` apart."""
    cmd, vel, base = [], [], []
    for number in range(count):
        due = number * PERIOD
        odd = number % 2
        came = due + round((hop_ms + odd * cmd_ms) * MS)
        cmd.append((CMD, number, due, came))
        vel.append((VEL, number, due, due + round((hop_ms + delay_ms + odd * vel_ms) * MS)))
        base.append((VEL, number, due, vel[-1][3] + MS))
    sent = frame(("sequence", "late_ns"), [(number, 0) for number in range(count)])
    return Measured({"pc": frame(COLUMNS, cmd + vel), "base": frame(COLUMNS, base), "sent": sent})


def sd(late_ms: float) -> float:
    """Of 100 periods that are in turn so much longer and so much shorter; seconds."""
    return late_ms / 1e3 * math.sqrt(100 / 99)


def run(plan: Plan, measure: Callable[[Cell], Measured | None]) -> Results:
    measured = [(cell, measure(cell)) for cell in EXPERIMENT.cells(plan)]
    return Results(plan, [(cell, one) for cell, one in measured if one is not None])


def claim(claims: tuple[Claim, ...], words: str) -> Claim:
    (found,) = [one for one in claims if words in one.text]
    return found


# --- cells ----------------------------------------------------------------------------------------------------------


def by_system(cell: Cell) -> Measured:
    if contender_of(cell) == DIRECT:
        return made(0.315, 1.05, 60.0 if cell.settings["mode"] == "polled" else 0.46)
    if cell.settings["system"] == "rmpa":
        return made(0.6, 0.9, 60.3 if cell.settings["mode"] == "polled" else 0.5)
    return made(0.3, 1.0, 60.0 if cell.settings["mode"] == "polled" else 0.4)


# --- findings -------------------------------------------------------------------------------------------------------


def test_periods_and_delays_of_a_round() -> None:
    found = evaluate(made(0.3, 1.0, 60.0))
    assert found.mean("cmd") == pytest.approx(0.1)
    assert found.sd("cmd") == pytest.approx(sd(0.3))
    assert found.sd("vel") == found.sd("base") == pytest.approx(sd(1.0))
    assert found.sd("source") == pytest.approx(0.0)
    assert found.mean("delay") == pytest.approx(60.0e-3 + 50 / 101 * 0.7e-3)


def test_the_claims_hold_each_round_against_its_neighbour() -> None:
    claims = EXPERIMENT.findings(run(FULL, by_system)).claims
    cmd, vel = (claim(claims, f"{of} at the pc, polled, roscpp: RMPA / classic") for of in ("CMD", "VEL"))
    assert cmd.value == pytest.approx(2.0)
    assert vel.value == pytest.approx(0.9)
    assert (cmd.reached, cmd.paper) == (False, 1.86)
    assert (vel.reached, vel.paper) == (True, 1.56)
    later = claim(claims, "control delay, event, roscpp: RMPA less classic")
    # 0.5 and 0.4 ms at the even messages; at the odd ones VEL is 0.3 ms later than CMD, and 0.7.
    assert later.value == pytest.approx(0.1 + 50 / 101 * (0.3 - 0.7))
    assert later.reached
    polled = claim(claims, "control delay, polled, same phases, roscpp: RMPA / classic")
    assert polled.value == pytest.approx((60.3 + 50 / 101 * 0.3) / (60.0 + 50 / 101 * 0.7))
    assert polled.reached
    assert polled.paper == pytest.approx(0.59)
