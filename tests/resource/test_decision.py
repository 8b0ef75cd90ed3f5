"""Quality, and which profile is decided by it."""

from __future__ import annotations

import contextlib
import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from rmpa.core.errors import ConfigError
from rmpa.resource import limits
from rmpa.resource.adaptation import Adaptation, AdaptationSettings
from rmpa.resource.decision import Decider, LearntOffer, LearntOffers, OfferSource, Profile, ProfileScore
from rmpa.resource.quality import (
    MEASURED,
    Attribute,
    Bound,
    Direction,
    QoSRequest,
    Requirement,
    Scale,
    at_least,
    at_most,
    between,
    exactly,
    merge,
    parse_bound,
    parse_request,
    parse_requirement,
    quantity,
)
from tests.resource.rig import Apply, Recorder, bound

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


# --- what was learnt

QUICK, SLOW = Profile("quick", {"rate": 40.0}, cost=1), Profile("slow", {"rate": 20.0}, cost=2)
WANTED = bound(RATE, at_least=15)


def learnt(windows: int, rate: float = 10.0) -> LearntOffers:
    one = LearntOffers([QUICK, SLOW])
    for number in range(windows):
        one.window("quick", {"rate": rate + number % 3 - 1, "latency": 1.0})
    one.update()
    return one


def test_the_median_and_the_spread_of_the_last_windows_are_kept() -> None:
    one = learnt(limits.LEARNT_WINDOWS * 2)
    assert one.offers == {"quick": {"rate": LearntOffer(10.0, 2.0, limits.LEARNT_WINDOWS)}}
    again = LearntOffers([QUICK])
    again.restore(one.saved | {"gone": {"rate": [1.0]}})
    assert again.offers == one.offers
    assert again.saved == one.saved
    assert learnt(1).offers["quick"]["rate"] == LearntOffer(9.0, 0.0, 1)
    word = LearntOffers([Profile("a", {"mode": "low"})])
    word.window("a", {"mode": "low"})
    word.update()
    assert word.offers == {}


def test_profiles_are_compared_by_what_was_learnt_if_there_is_enough() -> None:
    def best(windows: int, *, by_learnt: bool) -> str | None:
        one = Decider("camera", ATTRIBUTES, [QUICK, SLOW], learnt(windows), by_learnt=by_learnt)
        found = one.decide({"rate": WANTED})
        return found.profile if found is not None else None

    enough = limits.LEARNT_LEAST
    assert (best(enough, by_learnt=False), best(enough - 1, by_learnt=True)) == ("quick", "quick")
    assert best(enough, by_learnt=True) == "slow"
    one = Decider("camera", ATTRIBUTES, [QUICK, SLOW], learnt(enough), by_learnt=True)
    term = one.explain({"rate": WANTED})[0].terms[0]
    assert (term.offered, term.learnt) == (10.0, LearntOffer(10.0, 1.75, enough))
    declared = Decider("camera", ATTRIBUTES, [QUICK, SLOW], learnt(enough)).explain({"rate": WANTED})[0].terms[0]
    assert (declared.offered, declared.learnt) == (40.0, term.learnt)


def test_a_change_by_what_was_learnt_says_so() -> None:
    out = Recorder()
    decider = Decider("camera", ATTRIBUTES, [QUICK, SLOW], learnt(limits.LEARNT_LEAST), by_learnt=True)
    one = Adaptation(ATTRIBUTES, decider, AdaptationSettings(offers=OfferSource.LEARNT), out)
    one.require(Requirement("/a", {"rate": WANTED}), 0.0)
    assert out.told == [Apply("slow", "/a asks for a quality")]
    one.applied(0.0)
    one.pin("quick", 1.0)
    why = "quick was chosen by hand (learnt: quick has given rate 10 Hz, declared 40 Hz)"
    assert out.told[-1] == Apply("quick", why)


# --- quantities and requests

ZOOM = Attribute("zoom", Direction.TARGET)


@pytest.mark.parametrize(
    ("text", "to", "value"),
    [
        ("20 Hz", "Hz", 20.0),
        ("0.02 kHz", "Hz", 20.0),
        ("50ms", "s", 0.05),
        ("  1e3 µs ", "ms", 1.0),
        (".5", "m", 0.5),
        (3, "m", 3.0),
        ("10 Mbit/s", "B/s", 1_250_000.0),
        ("5 %", "", 0.05),
        ("36 km/h", "m/s", 10.0),
        ("7 widgets", "widgets", 7.0),
    ],
)
def test_quantity_is_converted_to_the_unit(text: str | float, to: str, value: float) -> None:
    assert quantity(text, to, "rate") == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "to", "said"),
    [
        ("fast", "Hz", "not a number with a unit; for example 20 Hz"),
        ("20 kHzz", "Hz", "'kHzz' is not a unit known here; did you mean kHz?"),
        ("20 s", "Hz", "'s' is a unit of time; latency is a frequency, in 'Hz'"),
        ("20 s", "widgets", "'s' is a unit of time; latency is of its own, in 'widgets'"),
        (True, "Hz", "True is not a number with a unit"),
        (float("nan"), "Hz", "nan is not a number"),
        (float("inf"), "Hz", "inf is not a number"),
        ("1e999", "Hz", "inf is not a number"),
        ("", "Hz", "'' is not a number"),
    ],
)
def test_invalid_quantity_is_refused(text: str | float, to: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        quantity(text, to, "latency")
    assert said in str(caught.value)


def test_bounds_are_read_with_their_units() -> None:
    assert bound(RATE, at_least="0.02 kHz") == Bound(low=math.log(20))
    assert bound(LATENCY, at_most="50 ms", weight=2, hard=True) == Bound(high=math.log(0.05), weight=2, hard=True)
    assert bound(ZOOM, at_least=1, at_most=3) == Bound(1, 3)
    assert bound(ZOOM, exactly=2) == Bound(2, 2)
    assert bound(MODE, at_least="medium") == Bound(low=1)
    assert bound(FRAME, exactly=("map", "odom")) == Bound(words=frozenset({"map", "odom"}))
    assert bound(FRAME, exactly="map") == Bound(words=frozenset({"map"}))


def test_an_exact_value_where_more_is_better_is_a_lower_bound() -> None:
    assert bound(RATE, exactly=20) == Bound(low=math.log(20))
    assert bound(LATENCY, exactly=0.1) == Bound(high=math.log(0.1))


@pytest.mark.parametrize(
    ("attribute", "asked", "said"),
    [
        (ZOOM, {"at_least": 3, "at_most": 1}, "the bounds are the wrong way round"),
        (ZOOM, {}, "nothing is asked of it; give at_least, at_most or exactly"),
        (ZOOM, {"at_least": 1, "exactly": 2}, "give one or the other"),
        (ZOOM, {"exactly": ("a",)}, "it takes no such words"),
        (
            RATE,
            {"at_most": 20},
            "more is better, so a bound on the other side asks for nothing; give at_least (>=) alone",
        ),
        (RATE, {"at_least": 5, "at_most": 3}, "the bounds are the wrong way round"),
        (RATE, {"at_least": 5, "at_most": 20}, "give at_least (>=) alone"),
        (LATENCY, {"at_least": 20}, "less is better"),
        (RATE, {"at_least": -5}, "-5 is below 0; rate has a logarithmic scale"),
        (RATE, {"at_least": "20 s"}, "'s' is a unit of time"),
        (MODE, {"at_least": "huge"}, "'huge' is no value of mode; it is one of low, medium, high"),
        (FRAME, {"exactly": "moon"}, "'moon' is no value of frame"),
        (FRAME, {"at_least": "map"}, "give exactly, one word or more"),
        (RATE, {"at_least": 5, "weight": 0}, "a weight of 0"),
        (RATE, {"at_least": 5, "weight": math.nan}, "a weight of nan"),
    ],
)
def test_invalid_request_is_refused(attribute: Attribute, asked: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        bound(attribute, **asked)
    assert said in str(caught.value)
    assert f"requirement of {attribute.name}" in str(caught.value)


def test_intervals_are_intersected() -> None:
    one = Requirement("a", {"zoom": Bound(1, 5, weight=2)})
    other = Requirement("b", {"zoom": Bound(3, 9, hard=True), "rate": Bound(low=1)})
    assert merge([one, other]) == ({"zoom": Bound(3, 5, weight=2, hard=True), "rate": Bound(low=1)}, [])
    touching = Requirement("c", {"zoom": Bound(5, 7)})
    assert merge([one, touching]) == ({"zoom": Bound(5, 5, weight=2)}, [])


def test_an_empty_intersection_is_resolved_by_priority_and_reported() -> None:
    low = Requirement("low", {"zoom": Bound(1, 2, weight=9)}, priority=0)
    high = Requirement("high", {"zoom": Bound(3, 4)}, priority=5)
    conflict = "low", "zoom: what low asks contradicts high and is left out"
    assert merge([low, high]) == ({"zoom": Bound(3, 4)}, [conflict])


def test_of_equal_priorities_the_earlier_one_stays() -> None:
    both = [Requirement(name, {"frame": Bound(words=frozenset({name}))}) for name in ("map", "odom")]
    bounds, conflicts = merge(both)
    assert bounds["frame"].words == {"map"}
    assert [client for client, _ in conflicts] == ["odom"]


_bounds = st.tuples(st.integers(0, 9), st.integers(0, 9)).map(lambda ends: Bound(min(ends), max(ends)))
_requirements = st.lists(
    st.builds(Requirement, st.uuids().map(str), st.dictionaries(st.sampled_from("abc"), _bounds), st.integers(0, 3)),
    max_size=8,
)


@given(_requirements)
def test_merge_satisfies_all_but_reported_conflicts(requirements: list[Requirement]) -> None:
    bounds, conflicts = merge(requirements)
    told = {(client, text.partition(":")[0]) for client, text in conflicts}
    for requirement in requirements:
        for name, asked in requirement.bounds.items():
            both = bounds[name]
            assert both.low <= both.high
            if (requirement.client, name) not in told:
                assert asked.low <= both.low <= both.high <= asked.high


@given(_requirements)
def test_highest_priority_never_conflicts(requirements: list[Requirement]) -> None:
    if requirements:
        highest = max(requirements, key=lambda requirement: requirement.priority)
        assert highest.client not in dict(merge(requirements)[1])


# --- texts


@pytest.mark.parametrize(
    ("text", "wish"),
    [
        (">= 20 Hz", at_least("20 Hz")),
        (">=20Hz hard", at_least("20Hz", hard=True)),
        ("<= 50 ms hard weight=2", at_most("50 ms", hard=True, weight=2)),
        ("<= 50 ms weight=2.5  hard ", at_most("50 ms", hard=True, weight=2.5)),
        ("1 .. 3 m", between("1", "3 m")),
        ("= map", exactly("map")),
        ("== map", exactly("map")),
        ("= map | odom", exactly("map", "odom")),
    ],
)
def test_what_people_write_is_read(text: str, wish: QoSRequest) -> None:
    assert parse_request(text, "x") == wish


WISHES = {
    "rate": RATE,
    "latency": LATENCY,
    "zoom": Attribute("zoom", Direction.TARGET, "m"),
    "frame": FRAME,
}


def test_an_interval_has_one_unit() -> None:
    assert parse_bound("1 .. 300 cm", "zoom", WISHES, "camera") == Bound(0.01, 3.0)
    assert parse_bound("1 m .. 300 cm", "zoom", WISHES, "camera") == Bound(1.0, 3.0)
    assert parse_bound("1 .. 3", "zoom", WISHES, "camera") == Bound(1.0, 3.0)


@pytest.mark.parametrize(
    ("key", "text", "said"),
    [
        ("rate", "20 Hz", "'20 Hz' is no bound; write"),
        ("rate", "", "'' is no bound"),
        ("rate", ">=", "'>=' lacks a value"),
        ("rate", ">= 20 Hz weight=much", "'weight=much' is no weight"),
        ("rate", ">= 20 Hz weight=-1", "a weight of -1"),
        ("rate", ">= 20 m", "'m' is a unit of length"),
        ("rats", ">= 20 Hz", "camera has no such attribute; did you mean rate?"),
        ("zoom", "3 .. 1 m", "the bounds are the wrong way round"),
        ("frame", "= moon", "'moon' is no value of frame"),
        ("priority", "high", "'high' is no whole number"),
        ("expires", "-3 s", "'-3 s' is over already"),
        ("expires", "3 m", "'m' is a unit of length"),
        ("rate", "x" * 2000, "2000 characters"),
    ],
)
def test_unreadable_requirement_is_refused(key: str, text: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_requirement("/c", [(key, text)], WISHES, "camera", 0.0)
    assert said in str(caught.value)


def test_a_whole_requirement() -> None:
    asked = [("rate", ">= 20 Hz"), ("priority", " 3 "), ("expires", "1 min"), ("frame", "= map|odom hard")]
    bounds = {"rate": Bound(low=math.log(20)), "frame": Bound(words=frozenset({"map", "odom"}), hard=True)}
    assert parse_requirement("/c", asked, WISHES, "camera", 100.0) == Requirement("/c", bounds, 3, 160.0)
    with pytest.raises(ConfigError, match="it is asked twice"):
        parse_requirement("/c", [("rate", ">= 1"), ("rate", ">= 2")], WISHES, "camera", 0.0)
    with pytest.raises(ConfigError, match="more than 256 bounds"):
        parse_requirement("/c", [("priority", "1")] * 300, WISHES, "camera", 0.0)


_wishes = st.one_of(
    st.builds(at_least, st.sampled_from(["20 Hz", "3"]), hard=st.booleans(), weight=st.sampled_from([1.0, 2.0, 0.5])),
    st.builds(at_most, st.sampled_from(["20 ms", "3"]), hard=st.booleans()),
    st.builds(between, st.sampled_from(["1"]), st.sampled_from(["3 m"]), hard=st.booleans()),
    st.builds(lambda words: exactly(*words), st.lists(st.sampled_from("abc"), min_size=1, max_size=3)),
)


@given(_wishes)
def test_what_a_wish_shows_is_read_as_the_same(wish: QoSRequest) -> None:
    assert parse_request(str(wish), "x") == wish


@given(st.text(max_size=80))
def test_no_text_does_worse_than_a_config_error(text: str) -> None:
    with contextlib.suppress(ConfigError):
        parse_requirement("/c", [("rate", text), ("zoom", text), ("frame", text)], WISHES, "camera", 0.0)
