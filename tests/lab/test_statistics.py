"""Statistics: against samples whose figures are known."""

from __future__ import annotations

import io
import json
import math
import random
from typing import TYPE_CHECKING

import pytest
from rich.console import Console

from lab import results
from lab.findings import Claim
from lab.machine import histogram
from lab.samples import percentile, summary
from lab.statistics import (
    Outage,
    Ratio,
    delays,
    distribution,
    linear_fit,
    outages,
    periods,
    ratio,
    spread,
)
from lab.tables import dash, size, us
from lab.usage import Usage, add

if TYPE_CHECKING:
    from pathlib import Path

SECOND = 1_000_000_000

# F. J. Anscombe, Graphs in Statistical Analysis (1973): four sets with the same line y = 3 + 0.5 x.
ANSCOMBE_X = (10, 8, 13, 9, 11, 14, 6, 4, 12, 7, 5)
ANSCOMBE = [
    (ANSCOMBE_X, (8.04, 6.95, 7.58, 8.81, 8.33, 9.96, 7.24, 4.26, 10.84, 4.82, 5.68), 0.66654),
    (ANSCOMBE_X, (9.14, 8.14, 8.74, 8.77, 9.26, 8.10, 6.13, 3.10, 9.13, 7.26, 4.74), 0.66624),
    (ANSCOMBE_X, (7.46, 6.77, 12.74, 7.11, 7.81, 8.84, 6.08, 5.39, 8.15, 6.42, 5.73), 0.66632),
    ((8,) * 7 + (19,) + (8,) * 3, (6.58, 5.76, 7.71, 8.84, 8.47, 7.04, 5.25, 12.50, 5.56, 7.91, 6.89), 0.66671),
]

# NIST Statistical Reference Datasets, linear regression, "Norris" (y, x): calibration of ozone monitors.
NORRIS = """
0.1 0.2 338.8 337.4 118.1 118.2 888.0 884.6 9.2 10.1 228.1 226.5 668.5 666.3 998.5 996.3 449.1 448.6 778.9 777.0
559.2 558.2 0.3 0.4 0.1 0.6 778.1 775.5 668.8 666.9 339.3 338.0 448.9 447.5 10.8 11.6 557.7 556.0 228.3 228.1
998.0 995.8 888.8 887.6 119.6 120.2 0.3 0.3 0.6 0.3 557.6 556.8 339.3 339.1 888.0 887.2 998.5 999.0 778.9 779.0
10.2 11.1 117.6 118.3 228.9 229.2 668.4 669.1 449.2 448.9 0.2 0.5
"""


@pytest.mark.parametrize(("xs", "ys", "r2"), ANSCOMBE)
def test_anscombes_quartet(xs: tuple[float, ...], ys: tuple[float, ...], r2: float) -> None:
    fit = linear_fit(xs, ys)
    assert fit.slope == pytest.approx(0.5, abs=1e-3)
    assert fit.intercept == pytest.approx(3.0, abs=3e-3)
    assert fit.r2 == pytest.approx(r2, abs=5e-6)


def test_norris_to_nists_certified_values() -> None:
    numbers = [float(word) for word in NORRIS.split()]
    fit = linear_fit(numbers[1::2], numbers[::2])
    assert len(numbers) == 72
    assert fit.intercept == pytest.approx(-0.262323073774029, rel=1e-10)
    assert fit.slope == pytest.approx(1.00211681802045, rel=1e-13)
    assert fit.r2 == pytest.approx(0.999993745883712, rel=1e-13)


def test_a_level_line_explains_all_and_two_points_do() -> None:
    assert linear_fit([1, 2, 3], [7, 7, 7]) == linear_fit([5, 9], [7, 7])
    assert linear_fit([1, 3], [10, 20]).at(2) == 15


@pytest.mark.parametrize(
    ("values", "mean", "sd"),
    [  # NIST Statistical Reference Datasets, univariate: NumAcc1, and NumAcc4, which cancellation ruins
        ([10000001.0, 10000003.0, 10000002.0], 10000002.0, 1.0),
        ([10000000.2] + [10000000.1, 10000000.3] * 500, 10000000.2, 0.1),
    ],
)
def test_spread_to_nists_certified_values(values: list[float], mean: float, sd: float) -> None:
    made = spread(values)
    assert made.mean == pytest.approx(mean, rel=1e-15)
    assert made.sd == pytest.approx(sd, rel=1e-8)


def test_periods_are_between_neighbours_in_the_sequence_only() -> None:
    rows = [(0, 0), (1, SECOND), (3, 3 * SECOND), (4, 5 * SECOND), (4, 6 * SECOND)]
    assert periods(rows) == [1.0, 2.0]
    assert periods([]) == periods([(7, 1)]) == []


def test_delay_is_from_a_command_to_its_own_velocity() -> None:
    commands = [(0, 100), (1, 200), (2, 300)]
    velocities = [(1, 200 + SECOND), (2, 300 + 2 * SECOND), (2, 300 + 9 * SECOND), (3, 5)]
    assert delays(commands, velocities) == [(1, 1.0), (2, 2.0)]


def test_outages_between_messages() -> None:
    rows = [(0, 0), (1, SECOND // 10), (9, SECOND), (10, SECOND + SECOND // 10)]
    assert outages(rows, longest=0.5) == [Outage(SECOND // 10, SECOND, 7, back=True)]
    assert outages(rows, longest=0.5)[0].seconds == pytest.approx(0.9)
    assert outages(rows, longest=1.0) == []


def test_outages_at_the_ends() -> None:
    rows = [(4, 5 * SECOND), (5, 5 * SECOND + 1)]
    assert outages(rows, longest=1.0, span=(SECOND, 9 * SECOND)) == [
        Outage(SECOND, 5 * SECOND, 0, back=True),
        Outage(5 * SECOND + 1, 9 * SECOND, 0, back=False),
    ]
    assert outages([], longest=1.0, span=(0, 3 * SECOND)) == [Outage(0, 3 * SECOND, 0, back=False)]
    assert outages([], longest=1.0) == []


def test_an_outage_after_which_the_numbering_begins_again() -> None:
    assert outages([(99, 0), (3, 2 * SECOND)], longest=1.0) == [Outage(0, 2 * SECOND, 3, back=True)]


def test_ratio_is_of_medians_with_bounds_that_hold_it() -> None:
    made = ratio([2.0, 2.2, 1.8, 100.0, 2.1], [1.0, 1.1, 0.9, 1.0, 1.0])
    assert made is not None
    assert made.value == pytest.approx(2.1)
    assert made.low is not None
    assert made.high is not None
    assert made.low <= made.value <= made.high
    assert made == ratio([2.0, 2.2, 1.8, 100.0, 2.1], [1.0, 1.1, 0.9, 1.0, 1.0])  # the same draws


def test_the_bounds_of_a_ratio_cover_the_true_one() -> None:
    chance = random.Random(7)
    within = 0
    for _ in range(60):
        ours = [chance.gauss(3.0, 0.3) for _ in range(9)]
        base = [chance.gauss(2.0, 0.2) for _ in range(9)]
        made = ratio(ours, base)
        assert made is not None
        within += (made.low or math.inf) <= 1.5 <= (made.high or 0.0)
    assert 50 <= within <= 60


def test_ratio_leaves_rounds_out_that_failed() -> None:
    assert ratio([2.0, None, 4.0], [1.0, 5.0, None]) == Ratio(2.0, None, None, 1)
    assert ratio([], []) is None
    assert ratio([1.0], [0.0]) is None
    assert str(ratio([2.0], [1.0])) == "2"


@pytest.mark.parametrize("tail", [False, True])
def test_a_thinned_distribution_keeps_its_tail_and_stays_true(tail: bool) -> None:
    count = 100_000
    xs, shares = distribution([float(i) for i in range(count)], tail=tail)
    assert len(xs) == 2000
    assert xs[-400:] == [float(i) for i in range(count - 400 - tail, count - tail)]
    for x, share in zip(xs, shares, strict=True):
        assert share == pytest.approx((count - 1 - x) / count if tail else (x + 1) / count)


def test_nearest_rank() -> None:
    ordered = [float(n) for n in range(1, 101)]
    assert [percentile(ordered, p) for p in (0, 1, 50, 99, 99.9, 100)] == [1, 1, 50, 99, 100, 100]


@pytest.mark.parametrize(("count", "p99", "p999"), [(999, False, False), (1000, True, False), (10_000, True, True)])
def test_percentiles_need_samples_beyond_them(count: int, p99: bool, p999: bool) -> None:
    made = summary([1.0] * count)
    assert (made.p99 is not None, made.p999 is not None) == (p99, p999)


def test_loss_is_counted_and_nothing_is_made_of_no_samples() -> None:
    made = summary([], lost=7)
    assert (made.count, made.lost, made.p50, made.largest) == (0, 7, None, None)


def test_histogram_counts_each_sample_once() -> None:
    classes = histogram([1.0, 20.0, 20.1, 9_999.0, 1e9])
    assert sum(classes.values()) == 5
    assert (classes["≤20"], classes["≤50"], classes[">10000"]) == (2, 1, 1)


def test_spans_of_one_process_add_up() -> None:
    joined = add({"a": Usage(1.0, 2.0, 10)}, {"a": Usage(1.0, 2.0, 30)})
    assert joined["a"] == Usage(2.0, 4.0, 30)
    assert joined["a"].percent == 50.0


@pytest.mark.parametrize(
    ("value", "at_least", "reached"),
    [(0.9, False, True), (1.1, False, False), (1.1, True, True), (0.9, True, False), (None, False, None)],
)
def test_a_claim_is_reached_missed_or_unknown(value: float | None, at_least: bool, reached: bool | None) -> None:
    assert Claim("x", value, 1.0, at_least=at_least).reached is reached


def test_a_measurement_ends_with_verdicts_and_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results, "RESULTS", tmp_path / "results")
    out = io.StringIO()
    claims = [Claim("p99", 2.0, 1.0), Claim("share", None, 0.9, at_least=True)]
    console = Console(file=out, width=200)
    results.finish(console, "short", {"hz": 1}, {"rows": []}, tmp_path / "copy", claims=claims)
    assert "p99: 2.00 (to reach: ≤ 1): not reached" in out.getvalue()
    assert "share: - (to reach: ≥ 0.9): too few samples to say" in out.getvalue()
    document = json.loads((tmp_path / "copy").read_text())
    assert [row["reached"] for row in document["result"]["targets"]] == [False, None]
    assert (document["measurement"], document["settings"]) == ("short", {"hz": 1})
    assert sorted(path.suffix for path in (tmp_path / "results").iterdir()) == [".json"]


def test_numbers_as_text() -> None:
    assert [us(None), us(12.34), us(1234.5), dash(None), dash(0.954)] == ["-", "12.3", "1234", "-", "0.95"]
    assert [size(64), size(64 * 1024), size(1024 * 1024)] == ["64 B", "64 KB", "1 MB"]
