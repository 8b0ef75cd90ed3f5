"""How long it still takes."""

from __future__ import annotations

import pytest

from lab.experiments.estimate import Estimate


def test_before_anything_is_known_cells_take_what_was_expected() -> None:
    estimate = Estimate([10.0, 20.0, 30.0])
    assert estimate.left(0.0) == 60.0
    assert estimate.share(0.0) == 0.0
    assert estimate.cell(0.0) == (0.0, 0.0)
    estimate.begin(100.0)
    assert estimate.cell(104.0) == (4.0, 10.0)
    assert estimate.left(104.0) == 56.0
    assert estimate.share(105.0) == pytest.approx(5 / 60)


def test_the_pace_of_what_is_over_holds_for_the_rest() -> None:
    estimate = Estimate([10.0, 20.0, 30.0])
    estimate.begin(0.0)
    estimate.end(15.0)
    assert estimate.pace == 1.5
    assert estimate.left(15.0) == 75.0
    estimate.begin(15.0)
    assert estimate.cell(25.0) == (10.0, 30.0)
    assert estimate.left(25.0) == 65.0
    assert estimate.share(30.0) == pytest.approx(20 / 60)  # the half of the second


def test_a_cell_that_takes_longer_does_not_make_the_rest_shorter() -> None:
    estimate = Estimate([10.0, 20.0])
    estimate.begin(0.0)
    assert estimate.left(50.0) == 20.0
    assert estimate.share(50.0) == pytest.approx(10 / 30)


def test_a_second_attempt_is_the_same_cell() -> None:
    estimate = Estimate([10.0, 10.0])
    estimate.begin(0.0)
    estimate.begin(30.0)
    estimate.end(40.0)
    assert estimate.done == 1
    assert estimate.pace == 4.0


def test_at_the_end() -> None:
    estimate = Estimate([10.0])
    estimate.begin(0.0)
    estimate.end(10.0)
    assert (estimate.done, estimate.left(11.0), estimate.share(11.0)) == (1, 0.0, 1.0)


def test_nothing_to_do() -> None:
    assert (Estimate([]).left(0.0), Estimate([]).share(0.0)) == (0.0, 1.0)
