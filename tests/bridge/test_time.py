"""``/clock`` across modules: only where both sides say so, and from one node of one peer."""

from __future__ import annotations

from typing import Any

import pytest

from rmpa.bridge.messages import Advertise, Mismatch, Source, TopicOffer
from rmpa.bridge.policy import Policy
from rmpa.bridge.topics.exports import LocalSource
from rmpa.config.peer_rules import PolicySettings
from rmpa.config.settings import TimeSettings
from tests.bridge.recorder import Exports, Imports, Publish, Retract, Send, Warn

CLOCK = "rosgraph_msgs/Clock"
FIRST, SECOND = Source("/clock", "/gazebo"), Source("/clock", "/other")


def policy(follow: str = "", *, share: bool = False) -> Policy:
    return Policy(PolicySettings(), (), TimeSettings(follow, share=share))


def imports(follow: str, *names: str) -> Imports:
    machine = Imports(policy(follow), rng=lambda: 1.0)
    for number, name in enumerate(names, start=1):
        machine.link_up(number, name)
    return machine


def advertise(machine: Imports, peer: int, *sources: Source) -> list[Any]:
    return machine.advertised(peer, Advertise(added=tuple(TopicOffer(s.topic, s.node, CLOCK) for s in sources)))


def hidden(machine: Imports, peer: int, source: Source) -> str:
    entry = machine.entry(peer, source)
    return str(entry.hidden)


@pytest.mark.parametrize(
    ("time", "crosses"), [(TimeSettings(), 0), (TimeSettings("x"), 0), (TimeSettings("", share=True), 1)]
)
def test_it_is_offered_only_where_it_is_shared(time: TimeSettings, crosses: int) -> None:
    exports = Exports(Policy(PolicySettings(), (), time))
    exports.graph(
        "/clock", {"/gazebo": LocalSource(CLOCK, "http://x:1/"), "/rmpa/sim/gazebo": LocalSource(CLOCK, "")}
    )
    assert list(exports.offered) == [FIRST][:crosses], "what stands for another module's is not passed on"


def test_it_comes_from_the_peer_that_is_followed_alone() -> None:
    machine = imports("sim", "sim", "base")
    assert advertise(machine, 2, SECOND) == []
    assert "time comes from there alone" in hidden(machine, 2, SECOND)
    assert advertise(machine, 1, FIRST) == [Publish(1, FIRST, CLOCK)]
    nobody = imports("", "sim")
    assert advertise(nobody, 1, FIRST) == []
    assert "[time] follow names the peer" in hidden(nobody, 1, FIRST)


def test_a_second_source_is_refused_until_the_first_goes() -> None:
    machine = imports("sim", "sim")
    advertise(machine, 1, FIRST)
    actions = advertise(machine, 1, SECOND)
    text = "time comes from /gazebo of sim already, and has one source"
    assert actions == [
        Warn("clock.second", str(SECOND), f"{SECOND}: {text}"),
        Send(1, Mismatch("/clock", "/other", "", text)),
    ]
    over = Send(1, Mismatch("/clock", "/other", "", ""))
    assert machine.advertised(1, Advertise(removed=(FIRST,))) == [Retract(1, FIRST), Publish(1, SECOND, CLOCK), over]


def test_a_clock_of_this_module_is_in_the_way() -> None:
    machine = imports("sim", "sim")
    advertise(machine, 1, FIRST)
    actions = machine.local_type("/clock", CLOCK)
    assert Retract(1, FIRST) in actions
    assert any(
        isinstance(action, Warn) and "a node of this module publishes /clock" in action.text for action in actions
    )
    assert Publish(1, FIRST, CLOCK) in machine.local_type("/clock", None)
