from __future__ import annotations

import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from rmpa.core.errors import ConfigError
from rmpa.resource.decision import Decider, ProfileScore
from rmpa.resource.declare import Profile
from rmpa.resource.quality import MEASURED, Attribute, Bound, Direction, Scale
from tests.resource.rig import bound

RATE, LATENCY = MEASURED["rate"], MEASURED["latency"]

RESOLUTION = Attribute("resolution", Direction.MAX, "px")
MODE = Attribute("mode", Direction.MAX, scale=Scale.ORDINAL, words=("low", "medium", "high"))
FRAME = Attribute("frame", Direction.EXACT, scale=Scale.NOMINAL, words=("map", "odom"))
ATTRIBUTES = {a.name: a for a in (RATE, LATENCY, RESOLUTION, MODE, FRAME)}
FAST = Profile("fast", {"rate": 40.0, "latency": 0.01, "resolution": 320.0, "mode": "low", "frame": "odom"}, cost=2)
SHARP = Profile("sharp", {"rate": 10.0, "latency": 0.1, "resolution": 1280.0, "mode": "high", "frame": "map"}, cost=3)
SAVING = Profile("saving", {"rate": 5.0, "latency": 0.2, "resolution": 320.0, "mode": "low", "frame": "map"}, cost=1)


def decide(one: Decider, bounds: dict[str, Bound], excluded: dict[str, str] | None = None) -> ProfileScore:
    found = one.decide(bounds, excluded)
    assert found is not None
    return found


def decider(*profiles: Profile) -> Decider:
    return Decider("camera", ATTRIBUTES, profiles or (FAST, SHARP, SAVING))


@pytest.mark.parametrize(
    ("bounds", "profile"),
    [
        ({"rate": bound(RATE, at_least=30)}, "fast"),
        ({"resolution": bound(RESOLUTION, at_least=1000)}, "sharp"),
        ({"rate": bound(RATE, at_least=4)}, "saving"),  # all meet it: the cheapest
        ({}, "saving"),
        ({"mode": bound(MODE, at_least="medium")}, "sharp"),
        ({"frame": bound(FRAME, exactly="odom")}, "fast"),
        # Both cannot be had; the heavier one decides.
        ({"rate": bound(RATE, at_least=40, weight=3), "resolution": bound(RESOLUTION, at_least=1280)}, "fast"),
        ({"rate": bound(RATE, at_least=40), "resolution": bound(RESOLUTION, at_least=1280, weight=3)}, "sharp"),
        # A hard one excludes whatever the rest says.
        (
            {"rate": bound(RATE, at_least=20, hard=True), "resolution": bound(RESOLUTION, at_least=1280, weight=99)},
            "fast",
        ),
    ],
)
def test_the_most_similar_profile_serves(bounds: dict[str, Bound], profile: str) -> None:
    decision = decide(decider(), bounds)
    assert decision.profile == profile
    assert decision.feasible


def distance(one: Decider, name: str, bounds: dict[str, Bound]) -> float:
    return next(score.distance for score in one.explain(bounds) if score.profile == name)


def test_the_distance_is_the_formula() -> None:
    # Rates 40, 10, 5: the range is log 8. sharp falls short of 40 by log 4: 2/3 of it. Latency is met.
    bounds = {"rate": bound(RATE, at_least=40, weight=2), "latency": bound(LATENCY, at_most=0.1, weight=1)}
    assert distance(decider(), "sharp", bounds) == pytest.approx(math.sqrt(2 * (2 / 3) ** 2 / 3) + 0.003)
    assert distance(decider(), "fast", bounds) == pytest.approx(0.002)


def test_a_declared_tolerance_takes_the_place_of_the_range() -> None:
    rate = Attribute("rate", Direction.MAX, "Hz", Scale.LOG, tolerance=2.0)
    one = Decider("camera", {"rate": rate}, [Profile("slow", {"rate": 10.0})])
    assert distance(one, "slow", {"rate": bound(rate, at_least=40)}) == pytest.approx(2.0)


def test_without_a_range_a_shortfall_is_all_or_nothing() -> None:
    one = Decider("camera", {"rate": RATE}, [Profile("slow", {"rate": 10.0})])
    assert distance(one, "slow", {"rate": bound(RATE, at_least=11)}) == 1.0
    assert distance(one, "slow", {"rate": bound(RATE, at_least=9)}) == 0.0


def test_best_effort_serves_if_none_is_feasible() -> None:
    bounds = {"rate": bound(RATE, at_least=100, hard=True)}
    declared = Profile("limp", {"rate": 1.0}, best_effort=True)
    decision = decide(decider(FAST, SHARP, declared), bounds)
    assert (decision.profile, decision.feasible) == ("limp", False)
    decision = decide(decider(), bounds)
    assert (decision.profile, decision.feasible) == ("fast", False)


def test_the_least_hard_shortfall_comes_before_the_distance() -> None:
    bounds = {"rate": bound(RATE, at_least=100, hard=True), "resolution": bound(RESOLUTION, at_least=1280, weight=50)}
    assert decide(decider(), bounds).profile == "fast"


def test_profiles_that_are_left_out_are_not_taken() -> None:
    bounds = {"rate": bound(RATE, at_least=30)}
    failed = {"fast": "failed 2 s ago"}
    assert decide(decider(), bounds, failed).profile == "sharp"
    assert decider().explain(bounds, failed)[0].excluded == "failed 2 s ago"
    assert not decider().explain(bounds, failed)[0].feasible
    everything = dict.fromkeys(("fast", "sharp", "saving"), "broken")
    assert decider().decide(bounds, everything) is None


def test_what_a_profile_does_not_offer_falls_short() -> None:
    mute = Profile("mute", {})
    bounds = {"rate": bound(RATE, at_least=1, hard=True)}
    assert decide(decider(mute, FAST), bounds).profile == "fast"
    assert decider(mute).explain(bounds)[0].terms[0].offered is None


def test_of_what_no_profile_offers_only_a_measurement_can_tell() -> None:
    bounds = {"rate": bound(RATE, at_least=1, hard=True)}
    assert decide(decider(Profile("mute", {})), bounds).feasible


def test_every_term_is_explained() -> None:
    bounds = {
        "rate": bound(RATE, at_least="40 Hz", weight=2, hard=True),
        "latency": bound(LATENCY, at_most="50 ms"),
        "frame": bound(FRAME, exactly=("map", "odom")),
    }
    sharp = decider().explain(bounds)[1]
    assert sharp.profile == "sharp"
    assert [(t.attribute, t.offered, t.wanted, t.delta == 0) for t in sharp.terms] == [
        ("rate", 10.0, "at least 40 Hz", False),
        ("latency", 0.1, "at most 0.05 s", False),
        ("frame", "map", "map or odom", True),
    ]
    weighted = sum(t.weight * t.delta**2 for t in sharp.terms) / sum(t.weight for t in sharp.terms)
    assert sharp.distance == pytest.approx(math.sqrt(weighted) + 0.003)


def test_unknown_profile_has_a_suggestion() -> None:
    with pytest.raises(ConfigError, match="camera has no such profile; did you mean sharp"):
        decider().profile("shrap")


# --- properties ---------------------------------------------------------------------------------------------------

X = Attribute("x", Direction.MAX)
Y = Attribute("y", Direction.MAX)
_numbers = st.floats(0, 100, allow_nan=False)
_offers = st.fixed_dictionaries({"x": _numbers, "y": _numbers})
_profiles = st.lists(_offers, min_size=1, max_size=6).map(
    lambda offers: [Profile(f"p{i}", offer) for i, offer in enumerate(offers)]
)
_asked = st.fixed_dictionaries(
    {name: st.builds(Bound, _numbers, weight=st.floats(0.1, 10), hard=st.booleans()) for name in ("x", "y")}
)


def plane(profiles: list[Profile]) -> Decider:
    return Decider("plane", {"x": X, "y": Y}, profiles)


@given(_profiles, _asked)
def test_better_values_have_no_shortfall(profiles: list[Profile], asked: dict[str, Bound]) -> None:
    enough = {name: Bound(0.0, weight=b.weight, hard=b.hard) for name, b in asked.items()}
    assert all(score.distance == 0.0 and score.feasible for score in plane(profiles).explain(enough))


@given(_profiles, _asked)
def test_decision_is_feasible_if_any_profile_is(profiles: list[Profile], asked: dict[str, Bound]) -> None:
    decider = plane(profiles)
    scores = decider.explain(asked)
    decision = decide(decider, asked)
    assert decision.feasible == any(score.feasible for score in scores)
    among = [s for s in scores if s.feasible] or list(scores)
    taken = next(score for score in scores if score.profile == decision.profile)
    assert decision.distance == taken.distance  # to the bit, however many of them were worked out
    if decision.feasible:
        assert taken.distance == min(score.distance for score in among)
    else:
        assert taken.hard_shortfall == min(score.hard_shortfall for score in among)


@given(_profiles, _asked, st.floats(1.1, 100))
def test_a_greater_weight_never_favours_who_falls_shorter(
    profiles: list[Profile], asked: dict[str, Bound], factor: float
) -> None:
    soft = {name: Bound(b.low, weight=b.weight) for name, b in asked.items()}
    heavier = soft | {"x": Bound(soft["x"].low, weight=soft["x"].weight * factor)}
    decider = plane(profiles)

    def short(bounds: dict[str, Bound]) -> float:
        taken = decide(decider, bounds).profile
        terms = next(score for score in decider.explain(bounds) if score.profile == taken).terms
        return next(term for term in terms if term.attribute == "x").delta

    assert short(heavier) <= short(soft) + 1e-9


@given(_profiles, _asked, st.integers(0, 5), st.floats(0, 1), st.floats(0, 1))
def test_worse_profile_within_the_range_changes_nothing(
    profiles: list[Profile], asked: dict[str, Bound], which: int, dx: float, dy: float
) -> None:
    before = decide(plane(profiles), asked)
    model = profiles[which % len(profiles)]
    least = {name: min(float(p.offers[name]) for p in profiles) for name in ("x", "y")}
    worse = Profile(
        "worse",
        {
            name: least[name] + (float(model.offers[name]) - least[name]) * part
            for name, part in (("x", dx), ("y", dy))
        },
        cost=1,
    )
    assume(all(float(worse.offers[name]) <= float(model.offers[name]) for name in ("x", "y")))
    assert decide(plane([*profiles, worse]), asked) == before


@given(_profiles, _asked)
def test_ties_go_to_the_one_declared_first(profiles: list[Profile], asked: dict[str, Bound]) -> None:
    twins = [*profiles, *(Profile(f"twin of {p.name}", p.offers) for p in profiles)]
    assert decide(plane(twins), asked).profile == decide(plane(profiles), asked).profile
