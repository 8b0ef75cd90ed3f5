from __future__ import annotations

import msgspec
import pytest

from rmpa.core.errors import ConfigError
from rmpa.resource.decide.reports import SavedCoolDown, SavedRequirement, SavedState
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
    state = SavedState(
        parameters={"gain": 2, "frame": "sonar_link"},
        requirements=(asked(expires_ns=NOW + 12 * SECOND),),
        chosen="fine",
        last="fine",
        context="docked",
        cool_downs={"fine": SavedCoolDown(until_ns=NOW + SECOND, cool_down=20.0, why="no bus")},
    )
    found, lost = msgspec.json.decode(msgspec.json.encode(state), type=SavedState).checked(sonar(), NOW)
    assert lost == []
    assert found == state
    assert isinstance(found.parameters["gain"], float)
    requirement = found.requirements[0].requirement(sonar().attributes, "sonar", 100.0, NOW)
    assert requirement is not None
    assert (requirement.client, requirement.priority, requirement.expires) == ("/driver", 2, 112.0)
    assert requirement.bounds["noise"].hard


def test_expired_requirement_is_not_restored() -> None:
    found, lost = SavedState(requirements=(asked(expires_ns=NOW - 1),)).checked(sonar(), NOW)
    assert (found.requirements, lost) == ((), [])


@pytest.mark.parametrize(
    ("state", "said"),
    [
        (SavedState(parameters={"gain": 11}), "too much"),
        (SavedState(parameters={"gain": "loud"}), "no double"),
        (SavedState(parameters={"power": 1}), "parameter power: it is declared no longer"),
        (SavedState(chosen="exact"), "profile exact: it is declared no longer"),
        (SavedState(last="exact"), "profile exact: it is declared no longer"),
        (SavedState(context="away"), "context away: it is declared no longer"),
        (SavedState(requirements=(SavedRequirement(client="/a", values=(("nois", ">= 1"),)),)), "nois"),
        (SavedState(requirements=(SavedRequirement(client="/a", values=(("noise", "soft"),)),)), "soft"),
        (SavedState(cool_downs={"exact": SavedCoolDown(until_ns=1, cool_down=1)}), "declared no longer"),
    ],
)
def test_what_does_not_fit_any_more_is_left_out_and_reported(state: SavedState, said: str) -> None:
    known = msgspec.structs.replace(state, parameters={**state.parameters, "count": 7})
    found, lost = known.checked(sonar(), NOW)
    assert found == SavedState(parameters={"count": 7})
    (text,) = lost
    assert said in text


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
    one = SavedCoolDown(until_ns=NOW + ahead * SECOND, cool_down=20.0, why="no bus").left(100.0, NOW)
    assert (one and (one.until, one.cool_down, one.why)) == (left and (100.0 + left, 20.0, "no bus"))


def test_a_clock_that_was_set_back_makes_no_request_longer() -> None:
    one = asked(expires_ns=NOW + 10**9 * SECOND).requirement(sonar().attributes, "sonar", 100.0, NOW)
    assert one is not None
    assert one.expires == 130.0
