from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import ConfigError
from rmpa.resource.decide.saved_state import (
    CHOSEN,
    CONTEXT,
    COOL_DOWN,
    LAST,
    SavedCoolDown,
    SavedRequirement,
    read_saved_state,
)
from rmpa.resource.declare.resource import Resource

NOW = 1_800_000_000_000_000_000
SECOND = 1_000_000_000


def sonar() -> Resource:
    one = Resource("sonar", role="sensing")
    one.output("ranges", "std_msgs/String")
    one.attribute("noise", better="min", unit="m")
    one.parameter("gain", 1.0, low=0.0, high=10.0)
    one.parameter("count", 3)
    one.parameter("frame", "base")
    one.profile(offers={"noise": "1 cm"}, name="fine")(lambda: None)
    one.context("docked")
    return one


def asked(**options: object) -> SavedRequirement:
    values = (("noise", "<= 5 cm hard"), ("priority", "2"), ("expires", "30 s"))
    return SavedRequirement(client="/driver", values=values, mark="m1", **options)  # type: ignore[arg-type] # of the struct


def test_what_was_kept_comes_back() -> None:
    rows = {
        ("parameter", "gain"): "2",
        ("parameter", "frame"): '"sonar_link"',
        ("requirement", "/driver"): asked(expires_ns=NOW + 12 * SECOND).serialize(),
        CHOSEN: '"fine"',
        LAST: '"fine"',
        CONTEXT: '"docked"',
    }
    found = read_saved_state(rows, sonar(), NOW)
    assert found.lost == ()
    assert found.parameters == {"gain": 2.0, "frame": "sonar_link"}
    assert isinstance(found.parameters["gain"], float)
    assert (found.chosen, found.last, found.context) == ("fine", "fine", "docked")
    (one,) = found.requirements
    requirement = one.requirement(sonar().attributes, "sonar", 100.0, NOW)
    assert requirement is not None
    assert (requirement.client, requirement.priority, requirement.expires) == ("/driver", 2, 112.0)
    assert requirement.bounds["noise"].hard


def test_expired_requirement_is_not_restored() -> None:
    found = read_saved_state({("requirement", "/driver"): asked(expires_ns=NOW - 1).serialize()}, sonar(), NOW)
    assert (found.requirements, found.lost) == ((), ())


@pytest.mark.parametrize(
    ("key", "text", "said"),
    [
        (("parameter", "gain"), "11", "too much"),
        (("parameter", "gain"), '"loud"', "no double"),
        (("parameter", "gain"), "null", "parameter gain"),
        (("parameter", "power"), "1", "declared no longer"),
        (CHOSEN, '"exact"', "declared no longer"),
        (LAST, "{", "profile last"),
        (CONTEXT, '"away"', "context away"),
        (("requirement", "/a"), '{"client": "/a", "values": [["nois", ">= 1"]]}', "nois"),
        (("requirement", "/a"), '{"client": "/a", "values": [["noise", "soft"]]}', "soft"),
        ((COOL_DOWN, "exact"), '{"until_ns": 1, "cool_down": 1}', "declared no longer"),
        ((COOL_DOWN, "fine"), '{"until_ns": "soon", "cool_down": 1}', "cool_down fine"),
        (("requirement", "/a"), "[" * 100_000, "requirement /a"),
    ],
)
def test_invalid_rows_are_left_out_and_reported(key: tuple[str, str], text: str, said: str) -> None:
    found = read_saved_state({key: text, ("parameter", "count"): "7"}, sonar(), NOW)
    assert found.parameters == {"count": 7}
    (lost,) = found.lost
    assert said in lost


@given(st.dictionaries(st.tuples(st.sampled_from(["parameter", "requirement", "profile"]), st.text()), st.text()))
def test_any_file_can_be_read(rows: dict[tuple[str, str], str]) -> None:
    found = read_saved_state(rows, sonar(), NOW)
    assert found.parameters.keys() <= {"gain", "count", "frame"}


def test_an_expiry_is_the_wall_clocks() -> None:
    with pytest.raises(ConfigError):
        SavedRequirement(client="/a", values=(("noise", "soft"),)).requirement(sonar().attributes, "sonar", 0.0, NOW)
    forever = SavedRequirement(client="/a", values=(("noise", "<= 1 m"),)).requirement(
        sonar().attributes, "sonar", 5.0, NOW
    )
    assert forever is not None
    assert forever.expires is None


@pytest.mark.parametrize(
    ("ahead", "left"),
    [(12, 12), (20, 20), (500, 20), (10**9, 20), (0, None), (-1, None), (-(10**9), None)],
    ids=["running", "just begun", "set back", "set back by decades", "over", "long over", "set forward by decades"],
)
def test_restored_cool_down_is_never_longer(ahead: int, left: int | None) -> None:
    row = SavedCoolDown(until_ns=NOW + ahead * SECOND, cool_down=20.0, why="no bus").serialize()
    found = read_saved_state({(COOL_DOWN, "fine"): row}, sonar(), NOW)
    one = found.cool_downs["fine"].left(100.0, NOW)
    assert (one and (one.until, one.cool_down, one.why)) == (left and (100.0 + left, 20.0, "no bus"))


def test_a_clock_that_was_set_back_makes_no_request_longer() -> None:
    one = asked(expires_ns=NOW + 10**9 * SECOND).requirement(sonar().attributes, "sonar", 100.0, NOW)
    assert one is not None
    assert one.expires == 130.0
