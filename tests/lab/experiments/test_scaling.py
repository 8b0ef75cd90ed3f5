"""Experiment 5: what is planned, and what follows from samples whose answers are known."""

from __future__ import annotations

import pytest

from lab.bed.plan import Plan
from lab.experiments.model import Cell, Measured, Results, Value
from lab.experiments.scaling import EXPERIMENT
from lab.frames import frame


def cell(system: str, modules: int, **more: Value) -> Cell:
    return Cell("scaling", {"system": system, **more, "client": "roscpp", "modules": modules, "round": 1})


def measured(latency_ms: float, idle: list[float], linked: list[float | None], messages: int = 600) -> Measured:
    processes: list[tuple[Value, ...]] = [("idle", f"agent@{n}", percent, 1) for n, percent in enumerate(idle)]
    processes += [("probe", "agent@1", 5.0, 1), ("probe", "nodes: source", 1.0, 1), ("probe", "nodes: sink", 2.0, 1)]
    arrivals = [(n, n * 10_000_000, n * 10_000_000 + int(latency_ms * 1e6)) for n in range(messages)]
    traffic = [("pc", 100.0, 300.0, 1.0, 3.0), ("m2", 200.0, 400.0, 2.0, 4.0)]
    columns = ("host", "tx_bytes_per_s", "rx_bytes_per_s", "tx_packets_per_s", "rx_packets_per_s")
    return Measured(
        {
            "joins": frame(("ready_s", "linked_s", "first_s"), [(0.1, one, 0.5) for one in linked]),
            "processes": frame(("while", "process", "cpu_percent", "rss_bytes"), processes),
            "traffic": frame(columns, traffic),
            "arrivals": frame(("sequence", "due_ns", "came_ns"), arrivals),
            "sent": frame(("sequence", "late_ns"), [(n, 0) for n in range(messages + 2)]),
        }
    )


RESULTS = Results(
    Plan(),
    [
        (cell("classic", 2), measured(0.2, [0.3], [None, None])),
        (cell("rmpa", 2), measured(0.4, [0.5, 0.7], [0.3, 0.5])),
        (cell("classic", 32), measured(0.4, [0.3], [None, None])),
        (cell("rmpa", 32), measured(1.2, [30.0, 32.0], [2.5, 1.0])),
    ],
)


def test_growth_is_held_against_what_classic_ros_did_on_the_same_machine() -> None:
    claims = EXPERIMENT.findings(RESULTS).claims
    growth = next(claim for claim in claims if claim.text.startswith("latency p50 with 32"))
    assert growth.value == pytest.approx((1.2 / 0.4) / (0.4 / 0.2))
    assert growth.reached is False
    linked = [claim for claim in claims if "all linked" in claim.text]
    assert [claim.value for claim in linked] == [pytest.approx(0.4), pytest.approx(1.75)]
