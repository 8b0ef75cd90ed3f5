from __future__ import annotations

from dataclasses import replace

import pytest

from rmpa.bridge.actions import Describe, Detach, Publish, Retract, Send, Warn
from rmpa.bridge.imports import TRANSITIONS, Imports, RouteState
from rmpa.bridge.messages import Advertise, Close, Closed, Description, Mismatch, Offer, Open, Opened, Source
from rmpa.bridge.policy import Policy
from rmpa.core import limits
from rmpa.core.config import PolicySettings
from rmpa.core.contract import Contract

CMD = Source("/cmd", "/joy")
OFFER = Offer("/cmd", "/joy", "sensor_msgs/Joy")
ABOUT = Description("sensor_msgs/Joy", "5a9ea5f83505693b71e785041e67a8bb", "Header header\n", False)


@pytest.fixture
def imports() -> Imports:
    machine = Imports(Policy(PolicySettings(deny=("/secret",))), rng=lambda: 1.0)
    machine.link_up(1)
    return machine


def state(imports: Imports, peer: int = 1) -> RouteState:
    entry = imports.get(peer, CMD)
    assert entry is not None
    return entry.state


def test_an_offer_is_visible_at_once_and_asks_for_no_data(imports: Imports) -> None:
    assert imports.advertised(1, Advertise(added=(OFFER,), full=True)) == [Publish(1, CMD, "sensor_msgs/Joy")]
    assert imports.advertised(1, Advertise(added=(OFFER,))) == []
    assert state(imports) is RouteState.IDLE
    assert imports.next_timer() is None


def test_the_receiving_side_judges_too(imports: Imports) -> None:
    offers = (Offer("/secret", "/joy", "a/B"), Offer("/rosout", "/joy", "rosgraph_msgs/Log"))
    assert imports.advertised(1, Advertise(added=offers)) == []
    entry = imports.get(1, Source("/secret", "/joy"))
    assert entry is not None
    assert "bridge.deny" in entry.hidden


def test_the_way_of_a_route(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    assert imports.demand(1, CMD, 0.0, wanted=True) == [Send(1, Open(1, "/cmd", "/joy"))]
    assert imports.demand(1, CMD, 0.0, wanted=True) == []
    assert imports.opened(1, Opened(1, ABOUT), 0.0) == [Describe(1, CMD, 1, ABOUT, Contract())]
    assert imports.demand(1, CMD, 10.0, wanted=False) == []
    assert state(imports) is RouteState.LINGERING
    assert imports.next_timer() == 10.0 + limits.ROUTE_LINGER
    assert imports.handle_timer(10.5) == []
    assert imports.demand(1, CMD, 10.6, wanted=True) == []
    assert state(imports) is RouteState.OPEN
    assert imports.next_timer() is None
    imports.demand(1, CMD, 20.0, wanted=False)
    assert imports.handle_timer(20.0 + limits.ROUTE_LINGER) == [Send(1, Close(1)), Detach(1, CMD, 1)]
    assert state(imports) is RouteState.IDLE
    assert imports.demand(1, CMD, 30.0, wanted=True) == [Send(1, Open(2, "/cmd", "/joy"))]


def test_a_closed_route_is_asked_for_again_with_a_growing_delay(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    imports.demand(1, CMD, 0.0, wanted=True)
    now, delays = 0.0, []
    for attempt in range(1, 8):
        assert imports.closed(1, Closed(attempt, "it hung up"), now) == [Detach(1, CMD, attempt)]
        assert state(imports) is RouteState.WAITING
        timer = imports.next_timer()
        assert timer is not None
        delays.append(round(timer - now, 3))
        now = timer
        assert imports.handle_timer(now) == [Send(1, Open(attempt + 1, "/cmd", "/joy"))]
    assert delays == [0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0]
    entry = imports.get(1, CMD)
    assert entry is not None
    assert entry.problem == "it hung up"
    imports.opened(1, Opened(8, ABOUT), now)
    assert entry.problem == ""


def test_an_answer_that_does_not_come_is_a_failure(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    imports.demand(1, CMD, 0.0, wanted=True)
    assert imports.handle_timer(limits.ROUTE_OPEN_TIMEOUT) == [Send(1, Close(1)), Detach(1, CMD, 1)]
    assert state(imports) is RouteState.WAITING
    assert imports.opened(1, Opened(1, ABOUT), 9.0) == []


def test_nobody_waits_for_what_nobody_wants(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    imports.demand(1, CMD, 0.0, wanted=True)
    assert imports.demand(1, CMD, 0.0, wanted=False) == [Send(1, Close(1)), Detach(1, CMD, 1)]
    assert imports.opened(1, Opened(1, ABOUT), 0.0) == []
    imports.demand(1, CMD, 0.0, wanted=True)
    imports.closed(1, Closed(2, "gone"), 0.0)
    assert imports.demand(1, CMD, 0.0, wanted=False) == []
    assert imports.next_timer() is None


def test_a_source_that_is_removed_leaves_nothing(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    imports.demand(1, CMD, 0.0, wanted=True)
    imports.opened(1, Opened(1, ABOUT), 0.0)
    assert imports.advertised(1, Advertise(removed=(CMD,))) == [
        Send(1, Close(1)),
        Detach(1, CMD, 1),
        Retract(1, CMD),
    ]
    assert imports.get(1, CMD) is None
    assert imports.advertised(1, Advertise(removed=(CMD,))) == []


def test_a_full_advertisement_removes_what_it_does_not_name(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER, Offer("/odom", "/base", "a/B"))))
    assert imports.advertised(1, Advertise(added=(OFFER,), full=True)) == [Retract(1, Source("/odom", "/base"))]


def test_a_link_that_falls_retracts_all_that_came_over_it_and_nothing_else(imports: Imports) -> None:
    imports.link_up(2)
    imports.advertised(1, Advertise(added=(OFFER,)))
    imports.advertised(2, Advertise(added=(OFFER,)))
    imports.demand(1, CMD, 0.0, wanted=True)
    imports.opened(1, Opened(1, ABOUT), 0.0)
    imports.demand(1, CMD, 0.0, wanted=False)
    assert list(imports.link_down(1)) == [Detach(1, CMD, 1), Retract(1, CMD)]
    assert imports.next_timer() is None
    assert state(imports, 2) is RouteState.IDLE
    assert imports.demand(1, CMD, 0.0, wanted=True) == []


def test_a_changed_type_is_retracted_and_published_anew(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    assert imports.advertised(1, Advertise(added=(Offer("/cmd", "/joy", "a/B"),))) == [
        Retract(1, CMD),
        Publish(1, CMD, "a/B"),
    ]


def test_another_type_than_the_local_one_is_refused_loudly_on_both_sides_until_it_goes(imports: Imports) -> None:
    imports.local_type("/cmd", "std_msgs/String")
    warn, told = imports.advertised(1, Advertise(added=(OFFER,)))
    assert isinstance(warn, Warn)
    assert "std_msgs/String" in warn.text
    assert "sensor_msgs/Joy" in warn.text
    assert isinstance(told, Send)
    assert isinstance(told.message, Mismatch)
    assert imports.demand(1, CMD, 0.0, wanted=False) == []
    assert imports.local_type("/cmd", None) == [Publish(1, CMD, "sensor_msgs/Joy")]
    retract, *loud = imports.local_type("/cmd", "std_msgs/String")
    assert retract == Retract(1, CMD)
    assert [type(action) for action in loud] == [Warn, Send]


def test_a_publisher_that_sends_another_type_than_offered_is_not_described(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    imports.demand(1, CMD, 0.0, wanted=True)
    odd = Description("a/B", "5a9ea5f83505693b71e785041e67a8bb", "", False)
    actions = imports.opened(1, Opened(1, odd), 0.0)
    assert [type(action) for action in actions] == [Send, Warn, Detach]
    assert state(imports) is RouteState.WAITING


def test_a_definition_that_does_not_fit_is_told_to_both_sides(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    warn, told = imports.mismatched(1, CMD, "/base", "other md5")
    assert warn == Warn("mismatch.md5", "/cmd from /joy", "other md5")
    assert told == Send(1, Mismatch("/cmd", "/joy", "/base", "other md5"))


def test_the_number_of_topics_is_bounded(imports: Imports, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "TOPICS_PER_PEER_MAX", 1)
    imports.advertised(1, Advertise(added=(OFFER,)))
    [action] = imports.advertised(1, Advertise(added=(Offer("/b", "/n", "a/B"),)))
    assert isinstance(action, Warn)


def test_the_number_of_nodes_is_bounded(imports: Imports, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "NODES_PER_PEER_MAX", 1)
    imports.advertised(1, Advertise(added=(OFFER,)))
    [action] = imports.advertised(1, Advertise(added=(Offer("/b", "/other", "a/B"),)))
    assert isinstance(action, Warn)
    assert action.kind == "nodes.too_many"
    more = Offer("/b", "/joy", "a/B")
    assert imports.advertised(1, Advertise(added=(more,))) == [Publish(1, more.source, "a/B")]
    imports.advertised(1, Advertise(removed=(CMD, more.source)))
    other = Offer("/b", "/other", "a/B")
    assert imports.advertised(1, Advertise(added=(other,))) == [Publish(1, other.source, "a/B")]


def many(count: int) -> tuple[Offer, ...]:
    return tuple(Offer(f"/t{index:04}", "/n", "a/B") for index in range(count))


def test_a_long_advertisement_comes_to_the_same_in_portions(imports: Imports) -> None:
    imports.link_up(2)
    for peer in (1, 2):
        imports.advertised(peer, Advertise(added=(OFFER, *many(50))))
    change = Advertise(added=many(100)[20:], full=True)
    whole = imports.advertised(1, change)
    portions = list(imports.portions(2, change))
    assert max(len(portion.added) + len(portion.removed) for portion in portions) <= 16
    parts = [action for portion in portions for action in imports.advertised(2, portion)]
    assert [replace(action, peer=1) for action in parts if isinstance(action, Publish | Retract)] == whole
    assert set(imports.offered_by(1)) == set(imports.offered_by(2)) == {offer.topic for offer in many(100)[20:]}


def test_many_timers_are_dealt_with_a_few_at_a_time(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=many(50)))
    for offer in many(50):
        imports.demand(1, offer.source, 0.0, wanted=True)
    rounds = 0
    while (due := imports.next_timer()) is not None and due <= 6.0:
        assert len(imports.handle_timer(6.0)) <= 48
        rounds += 1
    assert rounds > 3
    assert {entry.state for _, _, entry in imports} == {RouteState.WAITING}


def test_timers_that_were_set_anew_count_once(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    imports.demand(1, CMD, 0.0, wanted=True)
    imports.opened(1, Opened(1, ABOUT), 0.0)
    for now in range(10):
        imports.demand(1, CMD, float(now), wanted=False)
        imports.demand(1, CMD, now + 0.5, wanted=True)
    assert imports.next_timer() is None
    imports.demand(1, CMD, 20.0, wanted=False)
    assert imports.next_timer() == 20.0 + limits.ROUTE_LINGER


def test_what_changes_while_somebody_looks_does_no_harm(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=many(3)))
    seen = []
    for _, source, _ in imports:
        seen.append(source)
        imports.advertised(1, Advertise(added=(OFFER,), removed=(source,)))
    assert len(seen) == 3


def test_a_peer_that_nothing_waits_for_leaves_what_was_open(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER, *many(20))))
    imports.demand(1, CMD, 0.0, wanted=True)
    imports.opened(1, Opened(1, ABOUT), 0.0)
    assert not imports.waits_for(1)
    assert imports.detached(1) == [Detach(1, CMD, 1)]
    assert imports.detached(1) == []
    assert len(list(imports.link_down(1))) >= 21


def test_a_source_is_known_as_long_as_a_peer_offers_it(imports: Imports) -> None:
    imports.link_up(2)
    imports.advertised(2, Advertise(added=(OFFER,)))
    assert imports.knows(CMD)
    imports.link_down(2)
    assert not imports.knows(CMD)
    assert imports.offered_by(2) == ()


def test_every_state_can_be_left() -> None:
    assert set(TRANSITIONS) == set(RouteState)
    assert all(TRANSITIONS.values())
