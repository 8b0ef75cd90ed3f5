from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from rmpa.core.errors import ConfigError
from rmpa.resource.adaptation import Adaptation, AdaptationSettings, CoolDown
from rmpa.resource.decision import AlarmKind, Decider, Profile
from rmpa.resource.quality import MEASURED, Bound, Requirement
from tests.resource.rig import Action, Apply, Clear, Raise, Reacted, Recorder, bound

RATE, LATENCY = MEASURED["rate"], MEASURED["latency"]
ATTRIBUTES = {"rate": RATE, "latency": LATENCY}
FAST = Profile("fast", {"rate": 40.0, "latency": 0.01}, cost=9)
MIDDLE = Profile("middle", {"rate": 20.0, "latency": 0.02}, cost=5)
SLOW = Profile("slow", {"rate": 5.0, "latency": 0.1}, cost=1)
LIMP = Profile("limp", {"rate": 1.0, "latency": 0.5}, best_effort=True, cost=2)
SETTINGS = AdaptationSettings(
    violations=2, windows=3, improvement=0.05, dwell=2.0, settle=0.0, cool_down=10.0, apply_timeout=5.0
)


class Loop:
    """A loop of which each method returns what it tells its driver meanwhile, if anything."""

    def __init__(self, *profiles: Profile, settings: AdaptationSettings = SETTINGS) -> None:
        self.out = Recorder()
        decider = Decider("camera", ATTRIBUTES, profiles or (FAST, MIDDLE, SLOW))
        self.loop = Adaptation(ATTRIBUTES, decider, settings, self.out)

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.loop, name)
        if not callable(found):
            return found

        def call(*args: Any, **named: Any) -> Any:
            self.out.told = []
            result = found(*args, **named)
            return self.out.told if name == "window" or (result is None and name != "next_timer") else result

        return call


def at_least(rate: float, client: str = "/client", *, hard: bool = False, **more: float | None) -> Requirement:
    return Requirement(client, {"rate": bound(RATE, at_least=rate, hard=hard)}, **more)  # type: ignore[arg-type]


def started(*profiles: Profile) -> Loop:
    """A loop whose first profile runs at 0 s."""
    one = Loop(*profiles)
    one.reconsider("it starts", 0.0)
    finish(one, 0.0)
    return one


def restored(
    requirements: Sequence[Requirement] = (),
    last: str = "",
    cooling: dict[str, CoolDown] | None = None,
    now: float = 0.0,
) -> Loop:
    """A loop after a restart, not started yet."""
    one = Loop()
    one.restore(requirements, last, cooling or {}, now)
    return one


def running(rate: float, *profiles: Profile, hard: bool = True) -> Loop:
    """A loop whose client has what it asked for at 1 s."""
    one = started(*profiles)
    one.require(at_least(rate, hard=hard), 1.0)
    finish(one, 1.0)
    return one


def finish(one: Loop, now: float) -> list[Action]:
    done: list[Action] = []
    while one.applying:
        done += one.applied(now)
    return done


def applies(actions: list[Action]) -> list[str]:
    return [action.profile for action in actions if isinstance(action, Apply)]


def alarms(actions: list[Action]) -> list[tuple[AlarmKind, str, str]]:
    return [(a.alarm.kind, a.alarm.before, a.alarm.after) for a in actions if isinstance(a, Raise)]


def test_a_request_is_translated_into_the_most_similar_profile() -> None:
    one = Loop()
    assert applies(one.reconsider("it starts", 0.0)) == ["slow"]
    assert one.applied(0.5) == [Reacted("slow", 0.5)]
    assert applies(one.require(at_least(15), 1.0)) == ["middle"]
    assert (one.profile, one.applying) == ("slow", "middle")
    assert one.applied(1.25) == [Reacted("middle", 0.25)]
    assert (one.profile, one.applying) == ("middle", "")


def test_a_request_expires() -> None:
    one = running(1)
    one.require(at_least(30, "/guest", expires=60.0), 5.0)
    finish(one, 5.0)
    assert one.profile == "fast"
    assert one.next_timer() == 60.0
    assert applies(one.handle_timer(60.0)) == ["slow"]


def test_a_disturbance_takes_k_of_n_windows() -> None:
    one = running(15)
    assert one.profile == "middle"
    assert one.window({"rate": 8.0}, 2.0) == []
    assert one.window({"rate": 20.0}, 3.0) == []
    actions = one.window({"rate": 8.0}, 4.0)
    assert alarms(actions) == [(AlarmKind.ADAPTATION, "middle", "fast")]
    assert applies(actions) == ["fast"]
    raised = next(a.alarm for a in actions if isinstance(a, Raise))
    assert [(s.attribute, s.offered) for s in raised.shortfalls] == [("rate", 8.0)]
    # From the first window that was violated to the profile that runs.
    assert one.applied(4.5)[0] == Reacted("fast", 2.5)


def test_windows_that_were_long_ago_and_what_was_not_asked_do_not_count() -> None:
    one = running(15)
    for now, rate in enumerate([8, 20, 20, 8, 20, 20, 8], 2):
        assert one.window({"rate": float(rate), "latency": 9.0}, float(now)) == []


def test_an_alarm_is_over_when_the_windows_are_good_again() -> None:
    one = running(15)
    one.window({"rate": 8.0}, 2.0)
    one.window({"rate": 8.0}, 3.0)
    finish(one, 3.5)
    assert one.alarm is not None
    actions = one.window({"rate": 39.0}, 4.0)
    assert [type(action) for action in actions] == [Clear]
    assert one.alarm is None


def test_best_effort_runs_if_no_profile_can_serve() -> None:
    one = running(30, FAST, SLOW, LIMP)
    one.window({"rate": 20.0}, 2.0)
    actions = one.window({"rate": 20.0}, 3.0)
    assert alarms(actions) == [(AlarmKind.NON_ADAPTABLE, "fast", "limp")]
    assert applies(actions) == ["limp"]
    finish(one, 3.0)
    # While it lasts it is said once.
    assert alarms(one.window({"rate": 1.0}, 4.0)) == alarms(one.window({"rate": 1.0}, 5.0)) == []


def test_without_a_declared_best_effort_the_profile_stays() -> None:
    one = running(30)
    one.window({"rate": 20.0}, 2.0)
    actions = one.window({"rate": 20.0}, 3.0)
    assert alarms(actions) == [(AlarmKind.NON_ADAPTABLE, "fast", "fast")]
    assert applies(actions) == []
    for now in (4.0, 5.0):
        assert one.window({"rate": 39.0}, now) == []
    assert [type(a) for a in one.window({"rate": 39.0}, 6.0)] == [Clear]


def test_infeasible_request_is_non_adaptable_at_once() -> None:
    one = started()
    actions = one.require(at_least(100, hard=True), 1.0)
    assert alarms(actions) == [(AlarmKind.NON_ADAPTABLE, "slow", "fast")]
    raised = next(a.alarm for a in actions if isinstance(a, Raise))
    assert [(s.attribute, s.offered) for s in raised.shortfalls] == [("rate", 40.0)]
    finish(one, 1.0)
    assert [type(a) for a in one.require(at_least(10, hard=True), 2.0)] == [Clear, Apply]


def test_failed_profile_is_excluded_for_its_cool_down() -> None:
    one = started()
    assert applies(one.require(at_least(15, hard=True), 1.0)) == ["middle"]
    assert applies(one.failed("ValueError: no such mode", 1.1)) == ["fast"]
    finish(one, 1.2)
    assert one.explain(2.0)[1].excluded == "ValueError: no such mode"
    assert one.next_timer() == pytest.approx(11.1)
    assert applies(one.handle_timer(11.1)) == []  # back, but by the cost alone it is not worth a change
    assert one.explain(12.0)[1].excluded == ""


def test_first_ended_cool_down_retries() -> None:
    one = Loop(FAST, SLOW)
    one.reconsider("it starts", 0.0)
    assert applies(one.failed("broken", 1.0)) == ["fast"]
    assert one.failed("broken", 2.0) == []
    assert (one.applying, one.profile) == ("", "")
    assert applies(one.handle_timer(one.next_timer() or 0.0)) == ["slow"]


def test_cool_down_grows_with_each_violation() -> None:
    one = started(FAST, SLOW)
    outs = []
    now = 0.0
    one.require(at_least(30, hard=True), now)
    for _ in range(6):
        assert one.applying == "fast"
        one.failed("broken", now)
        finish(one, now)
        due = one.next_timer()
        assert due is not None
        outs.append(due - now)
        now = due
        one.handle_timer(now)
    assert outs == [10.0, 20.0, 40.0, 80.0, 160.0, 160.0]


def test_two_that_are_nearly_alike_do_not_alternate() -> None:
    alike = Profile("alike", {"rate": 39.0, "latency": 0.01}, cost=8)
    one = started(FAST, alike)
    assert one.profile == "alike"
    one.require(Requirement("/c", {"rate": bound(RATE, at_least=39.5)}), 1.0)
    finish(one, 1.0)
    before = one.profile
    for now in range(2, 30):
        assert one.window({"rate": 39.6}, float(now)) == []
    assert one.profile == before


def test_what_a_better_profile_waits_for_is_the_dwell_time() -> None:
    one = running(30, FAST, SLOW, hard=False)
    one.block({"fast": "battery low"}, 2.0)
    finish(one, 2.0)
    assert one.profile == "slow"
    assert one.block({}, 3.0) == []
    assert applies(one.window({"latency": 0.1}, 3.5)) == []
    assert applies(one.window({"latency": 0.1}, 4.5)) == ["fast"]


def test_a_choice_by_hand_holds_whatever_is_asked() -> None:
    one = running(30)
    assert applies(one.pin("slow", 2.0)) == ["slow"]
    finish(one, 2.0)
    for now in (3.0, 4.0, 5.0):
        assert one.window({"rate": 5.0}, now) == []
    assert applies(one.require(at_least(40), 6.0)) == []
    assert applies(one.pin("", 7.0)) == ["fast"]
    with pytest.raises(ConfigError, match="did you mean slow"):
        one.pin("slwo", 8.0)


def test_failed_choice_is_retried_after_its_cool_down() -> None:
    one = running(1)
    assert applies(one.pin("fast", 2.0)) == ["fast"]
    assert applies(one.failed("broken", 2.0)) == ["slow"]  # not the broken one over and over
    finish(one, 2.0)
    assert applies(one.handle_timer(one.next_timer() or 0.0)) == ["fast"]
    # Who chooses it anew does not wait.
    one.failed("broken", 12.0)
    finish(one, 12.0)
    assert applies(one.pin("fast", 12.5)) == ["fast"]


def test_request_while_applying_counts_afterwards() -> None:
    one = Loop()
    one.reconsider("it starts", 0.0)
    assert one.require(at_least(30), 0.1) == []
    assert applies(one.applied(0.2)) == ["fast"]


@pytest.mark.parametrize("seed", range(200))
def test_one_allowed_profile_is_applied_at_a_time(seed: int) -> None:
    chance = random.Random(seed)
    one = Loop(FAST, MIDDLE, SLOW, LIMP)
    now, outstanding = 0.0, ""
    raised = 0

    def take(actions: list[Action]) -> None:
        nonlocal outstanding, raised
        for action in actions:
            if isinstance(action, Apply):
                assert not outstanding, "a second profile before the first one was reported"
                excluded = {score.profile: score.excluded for score in one.explain(now)}
                assert not excluded[action.profile]
                outstanding = action.profile
            elif isinstance(action, Raise):
                raised += 1
                assert raised == 1, "two alarms at a time"
            elif isinstance(action, Clear):
                raised -= 1
        assert one.applying == outstanding

    take(one.reconsider("it starts", now))
    for _ in range(300):
        now += chance.choice((0.0, 0.1, 1.0, 4.0))
        while (due := one.next_timer()) is not None and due <= now:
            take(one.handle_timer(due))
        match chance.randrange(6):
            case 0:
                take(one.require(_any_requirement(chance, now), now))
            case 1 if one.requirements:
                take(one.release(chance.choice(list(one.requirements)), now))
            case 2:
                take(one.window({"rate": chance.choice((0.5, 4.0, 18.0, 45.0))}, now))
            case 3 if outstanding:
                outstanding = ""
                take(one.applied(now))
            case 4 if outstanding:
                outstanding = ""
                take(one.failed("by chance", now))
            case 5:
                barred = {name: "by chance" for name in ("fast", "middle") if chance.random() < 0.3}
                take(one.block(barred, now))


def _any_requirement(chance: random.Random, now: float) -> Requirement:
    bounds: dict[str, Bound] = {
        "rate": bound(RATE, at_least=chance.choice((1, 10, 30, 99)), hard=chance.random() < 0.5)
    }
    return Requirement(
        chance.choice(("/a", "/b", "/c")), bounds, chance.randrange(3), now + chance.choice((1.0, 50.0))
    )


def test_declared_soft_shortfall_is_no_disturbance() -> None:
    only = Profile("only", {"rate": 10.0, "latency": 0.1}, cost=1)
    one = running(20, only, hard=False)
    for second in range(2, 8):
        assert alarms(one.window({"rate": 10.0}, float(second))) == []
    one.window({"rate": 2.0}, 8.0)  # far less than the profile promised
    assert [kind for kind, _, _ in alarms(one.window({"rate": 2.0}, 9.0))] == [AlarmKind.NON_ADAPTABLE]


def test_restart_continues_with_profile_and_requirements() -> None:
    one = restored([at_least(15)], "fast")  # fast serves as well as middle does
    assert applies(one.reconsider("it starts", 0.0)) == ["fast"]
    one.applied(0.1)
    assert one.requirements.keys() == {"/client"}
    assert one.window({"rate": 40.0}, 5.0) == []
    assert applies(one.release("/client", 6.0)) == ["slow"]
    assert one.release("/client", 6.5) == []

    assert applies(restored([at_least(15, hard=True)], "slow").reconsider("it starts", 0.0)) == ["middle"]
    assert applies(restored([], "fast").pin("middle", 0.0)) == ["middle"]
    assert applies(restored([], "fast").block({"fast": "no power"}, 0.0)) == ["slow"]


def test_repeated_request_hides_no_disturbance() -> None:
    one = running(20.0, FAST, MIDDLE)
    actions: list[Action] = []
    for turn in range(3):  # rostopic pub -r 10
        assert one.require(at_least(20.0, hard=True), 1.5 + turn) == []
        if actions := one.window({"rate": 9.0}, 2.0 + turn):
            break
    assert applies(actions) == ["fast"]


def test_who_says_the_same_again_does_not_skip_the_dwell() -> None:
    one = running(20.0)
    one.block({"middle": "no current"}, 1.5)
    finish(one, 1.5)
    assert one.profile == "fast"
    one.block({}, 1.6)
    assert one.require(at_least(20.0, hard=True), 1.7) == []
    assert one.profile == "fast"


def test_windows_within_the_settling_time_do_not_count() -> None:
    one = Loop(FAST, MIDDLE, LIMP, settings=replace(SETTINGS, settle=1.5))
    one.reconsider("it starts", 0.0)
    one.require(at_least(15, hard=True), 0.0)
    finish(one, 0.0)
    assert one.profile == "middle"
    for second in range(1, 5):
        one.window({"rate": 20.0}, float(second))
    one.window({"rate": 2.0}, 5.0)
    assert applies(one.window({"rate": 2.0}, 6.0)) == ["fast"]
    finish(one, 6.0)
    # The windows that began at 6 and 7 s are of what was still on its way.
    assert [one.window({"rate": 2.0}, 7.0), one.window({"rate": 2.0}, 8.0)] == [[], []]
    assert one.window({"rate": 2.0}, 9.0) == []
    assert [kind for kind, _, _ in alarms(one.window({"rate": 2.0}, 10.0))] == [AlarmKind.NON_ADAPTABLE]


def test_restored_cool_down_runs_to_its_end() -> None:
    one = started()
    one.require(at_least(30), 1.0)
    assert applies(one.failed("no bus", 3.0)) == ["middle"]
    cooling = one.cooling(4.0)
    assert {name: (cool.until, cool.cool_down) for name, cool in cooling.items()} == {"fast": (13.0, 10.0)}
    again = restored([at_least(30)], "middle", cooling, 4.0)
    assert applies(again.reconsider("it starts", 4.0)) == ["middle"]
    finish(again, 4.0)
    assert again.explain(5.0)[0].excluded == "no bus"
    assert again.next_timer() == 13.0
    assert not again.cooling(13.0)
    assert applies(again.handle_timer(13.0)) == ["fast"]
    again.failed("no bus", 13.5)
    assert again.cooling(13.5)["fast"].cool_down == 20.0  # the next one is twice as long, as if nothing had been


def test_a_cool_down_of_a_file_is_no_longer_than_any_may_be() -> None:
    one = restored([at_least(30)], "", {"fast": CoolDown(1e9, 1e9, "odd")}, 1.0)
    assert one.cooling(1.0)["fast"].until == 161.0


def test_only_a_new_choice_ends_a_cool_down() -> None:
    cooling = {"fast": CoolDown(13.0, 10.0, "no bus")}
    assert applies(restored([], "", cooling, 4.0).pin("fast", 4.0, restored=True)) == ["slow"]
    assert applies(restored([], "", cooling, 4.0).pin("fast", 4.0)) == ["fast"]
