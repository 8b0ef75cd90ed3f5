from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapping import DEAD_ZONE, MAX_SPEED, MAX_TURN, beyond_dead_zone, limited, velocity_order


def test_full_stick_is_what_the_robot_can_do() -> None:
    assert velocity_order([1.0, 1.0], [1]) == (MAX_SPEED, MAX_TURN)
    assert velocity_order([-1.0, -1.0], [1]) == (-MAX_SPEED, -MAX_TURN)


def test_without_the_dead_man_button_it_stops() -> None:
    assert velocity_order([1.0, 1.0], [0]) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("axes", "buttons"),
    [([], []), ([], [1]), ([1.0], [1]), ([1.0, 1.0], []), ([math.nan, 1.0], [1]), ([1.0, math.inf], [1])],
)
def test_a_strange_joystick_is_a_stop(axes: list[float], buttons: list[int]) -> None:
    assert velocity_order(axes, buttons) == (0.0, 0.0)


def test_the_dead_zone_is_still_and_its_edge_does_not_jump() -> None:
    assert beyond_dead_zone(DEAD_ZONE) == 0.0
    assert beyond_dead_zone(-DEAD_ZONE / 2) == 0.0
    assert beyond_dead_zone(DEAD_ZONE + 1e-6) == pytest.approx(0.0, abs=1e-5)
    assert beyond_dead_zone(-0.55) == pytest.approx(-0.5)


@given(st.floats(), st.floats(), st.integers(0, 1))
def test_no_order_is_beyond_the_limits(left: float, forward: float, held: int) -> None:
    speed, turn = velocity_order([left, forward], [held])
    assert abs(speed) <= MAX_SPEED
    assert abs(turn) <= MAX_TURN


def test_limits() -> None:
    assert limited(2.0, 0.65) == 0.65
    assert limited(-2.0, 0.65) == -0.65
    assert limited(math.nan, 0.65) == 0.0
    assert limited(math.inf, 0.65) == 0.0
