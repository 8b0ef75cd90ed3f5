"""What is said of a ``/clock`` that is followed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from rmpa.config.settings import TimeSettings
from tests.agent.test_agent import node, running, until

if TYPE_CHECKING:
    from collections.abc import Callable

    from rmpa.config.settings import Settings


async def test_a_followed_clock_does_not_stay_home(settings: Callable[..., Settings]) -> None:
    shares = replace(settings("a"), time=TimeSettings(share=True))
    follows = replace(settings("b"), time=TimeSettings(follow="a"))
    async with running(shares, follows) as (a, b), node("simulator", a) as simulator, node("user", b) as user:
        await simulator.advertise("/clock", "rosgraph_msgs/Clock")
        await user.subscribe("/clock", "rosgraph_msgs/Clock", lambda _: None)
        await until(lambda: "/rmpa/a/simulator" in b.core.publishers("/clock"))
        (here,) = b.snapshots.build(frozenset({"/clock"})).topics
        assert [route.direction for route in here.routes] == ["in"]
        text = 'time.follow = "a": that module\'s comes here; one of this module does not cross'
        assert (here.crosses, here.policy) == (True, text)
        (there,) = a.snapshots.build(frozenset({"/clock"})).topics
        assert (there.crosses, there.policy) == (True, "time.share = true: peers may follow this module's time")


async def test_a_clock_without_followers_stays_home(settings: Callable[..., Settings]) -> None:
    async with running(settings("a"), settings("b")) as (a, _), node("simulator", a) as simulator:
        await simulator.advertise("/clock", "rosgraph_msgs/Clock")
        (shown,) = a.snapshots.build(frozenset({"/clock"})).topics
        assert (shown.crosses, shown.policy.startswith("built in: time does not cross")) == (False, True)
