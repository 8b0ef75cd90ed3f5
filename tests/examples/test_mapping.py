from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapping import DEAD_ZONE, MAX_SPEED, MAX_TURN, Ramp, beyond_dead_zone, limited, velocity_order


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


def test_a_ramp_gathers_speed_slowly_and_stops_at_once() -> None:
    ramp = Ramp()
    assert ramp.speed(0.6, 10.0) == 0.6, "without a limit it is what the stick says"
    assert ramp.speed(0.0, 10.1) == 0.0
    ramp.limit = 1.0
    for tick in range(1, 6):
        assert ramp.speed(0.5, 10.1 + tick / 10) == pytest.approx(tick / 10)
        assert ramp.acceleration == pytest.approx(1.0)
    assert ramp.delay(0.6) == pytest.approx(0.1)
    assert ramp.speed(0.5, 10.7) == 0.5
    assert ramp.speed(0.2, 10.8) == 0.2
    assert ramp.acceleration == 0.0
    assert ramp.speed(-0.5, 10.9) == pytest.approx(-0.1), "the other way it begins at a stop"
    assert ramp.speed(0.0, 11.0) == 0.0
    assert ramp.speed(0.5, 99.0) == pytest.approx(0.2), "a silence is no leap"
