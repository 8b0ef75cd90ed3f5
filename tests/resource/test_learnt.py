from __future__ import annotations

import asyncio
from pathlib import Path

from rmpa.resource import limits
from rmpa.resource.adaptation import Adaptation, AdaptationSettings
from rmpa.resource.decision import Decider, LearntOffer, LearntOffers, OfferSource, Profile
from rmpa.resource.node import ResourceNode
from rmpa.resource.quality import MEASURED, Requirement
from rmpa.resource.resource import Resource
from rmpa.ros.core.embedded import RosCore
from tests.resource.rig import Apply, Recorder, bound
from tests.resource.test_actuation import running
from tests.waiting import until

RATE = MEASURED["rate"]
ATTRIBUTES = {"rate": RATE}
FAST, SLOW = Profile("fast", {"rate": 40.0}, cost=1), Profile("slow", {"rate": 20.0}, cost=2)
WANTED = bound(RATE, at_least=15)


def learnt(windows: int, rate: float = 10.0) -> LearntOffers:
    one = LearntOffers([FAST, SLOW])
    for number in range(windows):
        one.window("fast", {"rate": rate + number % 3 - 1, "latency": 1.0})
    one.update()
    return one


def test_the_median_and_the_spread_of_the_last_windows_are_kept() -> None:
    one = learnt(limits.LEARNT_WINDOWS * 2)
    assert one.offers == {"fast": {"rate": LearntOffer(10.0, 2.0, limits.LEARNT_WINDOWS)}}
    again = LearntOffers([FAST])
    again.restore(one.saved | {"gone": {"rate": [1.0]}})
    assert again.offers == one.offers
    assert again.saved == one.saved
    assert learnt(1).offers["fast"]["rate"] == LearntOffer(9.0, 0.0, 1)
    word = LearntOffers([Profile("a", {"mode": "low"})])
    word.window("a", {"mode": "low"})
    word.update()
    assert word.offers == {}


def test_profiles_are_compared_by_what_was_learnt_if_there_is_enough() -> None:
    def best(windows: int, *, by_learnt: bool) -> str | None:
        one = Decider("camera", ATTRIBUTES, [FAST, SLOW], learnt(windows), by_learnt=by_learnt)
        found = one.decide({"rate": WANTED})
        return found.profile if found is not None else None

    enough = limits.LEARNT_LEAST
    assert (best(enough, by_learnt=False), best(enough - 1, by_learnt=True)) == ("fast", "fast")
    assert best(enough, by_learnt=True) == "slow"
    one = Decider("camera", ATTRIBUTES, [FAST, SLOW], learnt(enough), by_learnt=True)
    term = one.explain({"rate": WANTED})[0].terms[0]
    assert (term.offered, term.learnt) == (10.0, LearntOffer(10.0, 1.75, enough))
    declared = Decider("camera", ATTRIBUTES, [FAST, SLOW], learnt(enough)).explain({"rate": WANTED})[0].terms[0]
    assert (declared.offered, declared.learnt) == (40.0, term.learnt)


def test_a_change_by_what_was_learnt_says_so() -> None:
    out = Recorder()
    decider = Decider("camera", ATTRIBUTES, [FAST, SLOW], learnt(limits.LEARNT_LEAST), by_learnt=True)
    one = Adaptation(ATTRIBUTES, decider, AdaptationSettings(offers=OfferSource.LEARNT), out)
    one.require(Requirement("/a", {"rate": WANTED}), 0.0)
    assert out.told == [Apply("slow", "/a asks for a quality")]
    one.applied("slow", 0.0)
    one.pin("fast", 1.0)
    why = "fast was chosen by hand (learnt: fast has given rate 10 Hz, declared 40 Hz)"
    assert out.told[-1] == Apply("fast", why)


async def test_what_was_learnt_is_kept_over_a_restart(core: RosCore, tmp_path: Path) -> None:
    def sonar() -> Resource:
        one = Resource("sonar", role="sensing")
        noise = one.attribute("noise", better="min", unit="m")
        one.profile(offers={"noise": 0.01}, name="fine")(lambda: None)
        one.task(rate=100, name="ping")(lambda: noise.observe(0.25))
        one.adaptation(window="50 ms", settle=0)
        return one

    state = tmp_path / "sonar.json"
    async with running(core, sonar(), state) as one:
        await until(lambda: one.adapter.decision()["learnt"].get("fine", {}).get("noise", {}).get("n", 0) >= 10)
        assert one.adapter.decision()["learnt"]["fine"]["noise"]["median"] == 0.25
        kept = len(one.adapter.learnt._windows["fine"]["noise"])
    again = ResourceNode(sonar(), core.uri, state=state)
    await again.start()
    try:
        assert again.adapter.decision()["learnt"]["fine"]["noise"]["n"] >= min(kept, limits.LEARNT_WINDOWS)
    finally:
        await again.close()
    await asyncio.sleep(0)
