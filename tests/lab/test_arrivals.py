from __future__ import annotations

import pytest

from lab.arrivals import counted, counting_from, latencies, lost, pairs, source_periods
from lab.experiments.model import Table

CAME = Table(
    ("rate", "sequence", "due_ns", "came_ns"),
    [(10, 0, 1_000_000, 1_500_000), (10, 2, 3_000_000, 3_250_000), (20, 0, 7_000_000, 9_000_000)],
)
SENT = Table(("rate", "sequence", "late_ns"), [(10, 1, 500), (10, 0, 100), (10, 2, 0), (20, 0, 5)])


def test_rows_are_chosen_by_what_stands_in_a_column() -> None:
    assert pairs(CAME, rate=10) == [(0, 1_500_000), (2, 3_250_000)]
    assert pairs(CAME, rate=30) == []
    assert latencies(CAME, rate=10) == [0.5, 0.25]
    assert latencies(CAME) == [0.5, 0.25, 2.0]


def test_what_was_sent_and_never_came_is_lost_whatever_came_twice() -> None:
    assert lost(CAME, SENT, rate=10) == 1
    assert lost(Table(CAME.columns, [*CAME.rows, CAME.rows[2]]), SENT, rate=20) == 0


def test_the_sources_periods_are_in_the_order_of_the_sequence() -> None:
    assert source_periods(SENT, 10.0, rate=10) == pytest.approx([0.1 + 400e-9, 0.1 - 500e-9], abs=1e-12)


def test_messages_before_a_number_are_left_out() -> None:
    assert counting_from(CAME, 1).rows == [CAME.rows[1]]


def test_a_table_without_numbers_where_they_belong_is_refused() -> None:
    with pytest.raises(ValueError, match="'x' is no whole number"):
        pairs(Table(("sequence", "came_ns"), [("x", 1)]))


@pytest.mark.parametrize(
    ("value", "factor", "text"), [(None, 2.0, "-"), (0.0012345, 1e3, "1.23"), (12.345678, 1e3, "12,346")]
)
def test_figures_for_tables(value: float | None, factor: float, text: str) -> None:
    assert counted(value, factor=factor) == text
