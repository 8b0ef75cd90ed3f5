from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from unicycle import Pose, wrapped


def test_straight_on() -> None:
    assert Pose(1.0, 2.0, 0.0).moved(0.5, 0.0, 2.0) == Pose(2.0, 2.0, 0.0)


def test_a_spin_stays_in_place() -> None:
    pose = Pose(1.0, 2.0, 0.0).moved(0.0, 1.0, math.pi / 2)
    assert (pose.x, pose.y, pose.heading) == pytest.approx((1.0, 2.0, math.pi / 2))


def test_a_quarter_circle_to_the_left_is_exact_in_one_step() -> None:
    pose = Pose().moved(1.0, 1.0, math.pi / 2)
    assert (pose.x, pose.y, pose.heading) == pytest.approx((1.0, 1.0, math.pi / 2))


def test_a_full_circle_comes_back() -> None:
    pose = Pose(0.3, -0.2, 1.0).moved(0.5, -0.5, 4 * math.pi)
    assert (pose.x, pose.y, pose.heading) == pytest.approx((0.3, -0.2, 1.0))


finite = st.floats(-3, 3)


@given(finite, finite, st.floats(-3.1, 3.1), st.floats(0, 2), st.floats(0, 2))
def test_two_steps_are_one(speed: float, turn: float, heading: float, first: float, second: float) -> None:
    once = Pose(heading=heading).moved(speed, turn, first + second)
    twice = Pose(heading=heading).moved(speed, turn, first).moved(speed, turn, second)
    assert (once.x, once.y) == pytest.approx((twice.x, twice.y), abs=1e-6)
    assert math.cos(once.heading - twice.heading) == pytest.approx(1.0)


def test_headings_are_wrapped() -> None:
    assert wrapped(-math.pi) == math.pi
    assert wrapped(3 * math.pi) == pytest.approx(math.pi)
    assert wrapped(2 * math.pi + 0.1) == pytest.approx(0.1)
