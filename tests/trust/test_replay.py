"""The window of numbers: each is new once, in any order, beside a model."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rmpa.trust import limits
from rmpa.trust.packets import ReplayWindow, Verdict

RUN = (1, bytes(16))
NOW = 5.0


def test_what_is_behind_the_window_is_stale() -> None:
    window = ReplayWindow()
    window.take(RUN, 1000, NOW)
    assert window.take(RUN, 1001 - limits.REPLAY_WINDOW, NOW) is Verdict.ACCEPTED
    assert window.take(RUN, 1000 - limits.REPLAY_WINDOW, NOW) is Verdict.REPLAYED
    assert window.take(RUN, 0, NOW) is Verdict.REPLAYED


def test_zero_is_never_new() -> None:
    assert ReplayWindow().take(RUN, 0, NOW) is Verdict.REPLAYED


def test_the_highest_number_leaves_nothing_above_it() -> None:
    window = ReplayWindow()
    assert window.take(RUN, (1 << 64) - 1, NOW) is Verdict.ACCEPTED
    assert window.take(RUN, (1 << 64) - 1, NOW) is Verdict.REPEATED
    assert window.take(RUN, 1, NOW) is Verdict.REPLAYED


def test_a_leap_is_refused_and_leaves_nothing_behind() -> None:
    window = ReplayWindow()
    window.take(RUN, 10, NOW)
    assert window.take(RUN, (1 << 64) - 1, NOW) is Verdict.LEAP
    assert window.take(RUN, 11 + limits.REPLAY_LEAP, NOW) is Verdict.LEAP
    assert window.take(RUN, 11, NOW) is Verdict.ACCEPTED
    assert window.take(RUN, 11 + limits.REPLAY_LEAP, NOW) is Verdict.ACCEPTED


def test_a_run_that_was_out_of_reach_for_days_is_heard_again() -> None:
    window, days = ReplayWindow(), 3 * 86_400
    window.take(RUN, 1, NOW)
    assert window.take(RUN, 600 * days, NOW + days) is Verdict.ACCEPTED


def test_each_group_key_has_numbers_of_its_own() -> None:
    window = ReplayWindow()
    assert window.take((1, RUN[1]), (1 << 64) - 1, NOW) is Verdict.ACCEPTED
    assert window.take((2, RUN[1]), 7, NOW) is Verdict.ACCEPTED


def test_runs_are_apart_and_the_silent_one_is_forgotten() -> None:
    window = ReplayWindow(2)
    runs = [(1, bytes([n]) * 16) for n in range(3)]
    for run in runs[:2]:
        assert window.take(run, 7, NOW) is Verdict.ACCEPTED
    window.take(runs[0], 8, NOW)
    assert window.take(runs[2], 7, NOW) is Verdict.ACCEPTED
    assert len(window) == 2
    assert window.take(runs[0], 8, NOW) is Verdict.REPEATED
    assert window.take(runs[1], 7, NOW) is Verdict.ACCEPTED  # it was forgotten


@given(st.lists(st.integers(1, 200), max_size=100))
def test_beside_a_model(numbers: list[int]) -> None:
    window, seen = ReplayWindow(), set[int]()
    for number in numbers:
        if seen and max(seen) - number >= limits.REPLAY_WINDOW:
            expected = Verdict.REPLAYED
        else:
            expected = Verdict.REPEATED if number in seen else Verdict.ACCEPTED
            seen.add(number)
        assert window.take(RUN, number, NOW) is expected
