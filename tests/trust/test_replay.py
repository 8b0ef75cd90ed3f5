"""The window of numbers: each is new once, in any order, beside a model."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rmpa.trust import limits
from rmpa.trust.replay import Freshness, ReplayWindow

RUN = bytes(16)


def test_each_number_is_new_once() -> None:
    window = ReplayWindow()
    assert [window.take(RUN, n) for n in (1, 2, 2, 1, 5, 3)] == [
        Freshness.NEW,
        Freshness.NEW,
        Freshness.REPEATED,
        Freshness.REPEATED,
        Freshness.NEW,
        Freshness.NEW,
    ]


def test_what_is_behind_the_window_is_stale() -> None:
    window = ReplayWindow()
    window.take(RUN, 1000)
    assert window.take(RUN, 1001 - limits.REPLAY_WINDOW) is Freshness.NEW
    assert window.take(RUN, 1000 - limits.REPLAY_WINDOW) is Freshness.STALE
    assert window.take(RUN, 0) is Freshness.STALE


def test_zero_is_never_new() -> None:
    assert ReplayWindow().take(RUN, 0) is Freshness.STALE


def test_the_highest_number_leaves_nothing_above_it() -> None:
    window = ReplayWindow()
    assert window.take(RUN, (1 << 64) - 1) is Freshness.NEW
    assert window.take(RUN, (1 << 64) - 1) is Freshness.REPEATED
    assert window.take(RUN, 1) is Freshness.STALE


def test_runs_are_apart_and_the_silent_one_is_forgotten() -> None:
    window = ReplayWindow(2)
    runs = [bytes([n]) * 16 for n in range(3)]
    for run in runs[:2]:
        assert window.take(run, 7) is Freshness.NEW
    window.take(runs[0], 8)
    assert window.take(runs[2], 7) is Freshness.NEW
    assert len(window) == 2
    assert window.take(runs[0], 8) is Freshness.REPEATED
    assert window.take(runs[1], 7) is Freshness.NEW  # it was forgotten


@given(st.lists(st.integers(1, 200), max_size=100))
def test_beside_a_model(numbers: list[int]) -> None:
    window, seen = ReplayWindow(), set[int]()
    for number in numbers:
        if seen and max(seen) - number >= limits.REPLAY_WINDOW:
            expected = Freshness.STALE
        else:
            expected = Freshness.REPEATED if number in seen else Freshness.NEW
            seen.add(number)
        assert window.take(RUN, number) is expected
