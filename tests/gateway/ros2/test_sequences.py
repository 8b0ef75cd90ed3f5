"""Losses and repetitions by the numbers of publishers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hypothesis import given
from hypothesis import strategies as st

from rmpa.gateway import limits
from rmpa.gateway.ros2.format import Ros2Attachment
from rmpa.gateway.ros2.types import Ros2Sequences

if TYPE_CHECKING:
    import pytest


def numbered(sequence: int, gid: bytes = b"a") -> Ros2Attachment:
    return Ros2Attachment(sequence, 0, gid)


@given(st.sets(st.integers(1, 200), min_size=1))
def test_each_gap_is_a_loss(numbers: set[int]) -> None:
    counts = Ros2Sequences()
    assert all(counts.accept(numbered(number), history=False) for number in sorted(numbers))
    assert counts.lost == max(numbers) - min(numbers) + 1 - len(numbers)


def test_publishers_are_counted_apart_and_a_repetition_of_a_history_is_dropped() -> None:
    counts = Ros2Sequences()
    for number in (5, 6):
        assert counts.accept(numbered(number), history=True)
        assert counts.accept(numbered(number + 90, b"b"), history=True)
    assert not counts.accept(numbered(6), history=True)
    assert (counts.lost, counts.repeated) == (0, 1)
    assert counts.accept(numbered(1), history=False), "a publisher that counts anew"
    assert counts.accept(numbered(0), history=True), "a program that does not count"
    assert counts.accept(numbered(0), history=True)
    counts.forget()
    assert counts.accept(numbered(100), history=True)
    assert counts.lost == 0


def test_the_publishers_that_are_followed_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "ROS2_PUBLISHERS_MAX", 2)
    counts = Ros2Sequences()
    for gid in (b"a", b"b", b"c", b"a"):
        assert counts.accept(numbered(1, gid), history=True)
    assert counts.repeated == 0, "the one that was silent for longest was forgotten"
