from __future__ import annotations

from typing import Any

import pytest

from rmpa.bridge import limits
from rmpa.bridge.context import Names
from rmpa.bridge.messages import (
    Advertise,
    CloseRoute,
    Description,
    Mismatch,
    OpenRoute,
    RouteClosed,
    RouteOpened,
    Source,
    TopicOffer,
)
from rmpa.bridge.policy import Policy
from rmpa.config.peer_rules import PolicySettings
from rmpa.core.contract import Contract, ContractRule, Contracts, Reliability, Transport
from tests.bridge.recorder import Describe, Detach, Imports, Publish, Retract, Send, Warn

CMD = Source("/cmd", "/joy")
OFFER = TopicOffer("/cmd", "/joy", "sensor_msgs/Joy")
ABOUT = Description("sensor_msgs/Joy", "5a9ea5f83505693b71e785041e67a8bb", "Header header\n", False)


@pytest.fixture
def imports() -> Imports:
    machine = Imports(Policy(PolicySettings(deny=("/secret",))), rng=lambda: 1.0)
    machine.link_up(1)
    return machine


def state(imports: Imports, peer: int = 1) -> str:
    entry = imports.entry(peer, CMD)
    found: str = entry.state
    return found


def test_the_way_of_a_route(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    assert imports.demand(1, CMD, 0.0, wanted=True) == [Send(1, OpenRoute(1, "/cmd", "/joy"))]
    assert imports.demand(1, CMD, 0.0, wanted=True) == []
    assert imports.opened(1, RouteOpened(1, ABOUT), 0.0) == [Describe(1, CMD, 1, ABOUT, Contract())]
    assert imports.demand(1, CMD, 10.0, wanted=False) == []
    assert state(imports) == "lingering"
    assert imports.next_timer() == 10.0 + limits.ROUTE_LINGER
    assert imports.handle_timer(10.5) == []
    assert imports.demand(1, CMD, 10.6, wanted=True) == []
    assert state(imports) == "open"
    assert imports.next_timer() is None
    imports.demand(1, CMD, 20.0, wanted=False)
    assert imports.handle_timer(20.0 + limits.ROUTE_LINGER) == [Send(1, CloseRoute(1)), Detach(1, CMD, 1)]
    assert state(imports) == "idle"
    assert imports.demand(1, CMD, 30.0, wanted=True) == [Send(1, OpenRoute(2, "/cmd", "/joy"))]


def test_a_closed_route_is_asked_for_again_with_a_growing_delay(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    imports.demand(1, CMD, 0.0, wanted=True)
    now, delays = 0.0, []
    for attempt in range(1, 8):
        assert imports.closed(1, RouteClosed(attempt, "it closed the connection"), now) == [
            Detach(1, CMD, attempt, missed=True)
        ]
        assert state(imports) == "waiting"
        timer = imports.next_timer()
        assert timer is not None
        delays.append(round(timer - now, 3))
        now = timer
        assert imports.handle_timer(now) == [Send(1, OpenRoute(attempt + 1, "/cmd", "/joy"))]
    assert delays == [0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0]
    entry = imports.entry(1, CMD)
    assert entry.problem == "it closed the connection"
    imports.opened(1, RouteOpened(8, ABOUT), now)
    assert entry.problem == ""


def test_an_answer_may_take_as_long_as_the_publisher_does(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    imports.demand(1, CMD, 0.0, wanted=True)
    assert imports.next_timer() is None
    imports.opened(1, RouteOpened(1, ABOUT), 100.0)
    assert state(imports) == "open"


def test_nobody_waits_for_what_nobody_wants(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    imports.demand(1, CMD, 0.0, wanted=True)
    assert imports.demand(1, CMD, 0.0, wanted=False) == [Send(1, CloseRoute(1)), Detach(1, CMD, 1)]
    assert imports.opened(1, RouteOpened(1, ABOUT), 0.0) == []
    imports.demand(1, CMD, 0.0, wanted=True)
    imports.closed(1, RouteClosed(2, "gone"), 0.0)
    assert imports.demand(1, CMD, 0.0, wanted=False) == []
    assert imports.next_timer() is None


def test_a_lost_link_retracts_only_its_own_topics(imports: Imports) -> None:
    imports.link_up(2)
    imports.advertised(1, Advertise(added=(OFFER,)))
    imports.advertised(2, Advertise(added=(OFFER,)))
    imports.demand(1, CMD, 0.0, wanted=True)
    imports.opened(1, RouteOpened(1, ABOUT), 0.0)
    imports.demand(1, CMD, 0.0, wanted=False)
    imports.link_down(1)
    assert imports.get(1, CMD) is None
    assert imports.next_timer() is None
    assert state(imports, 2) == "idle"
    assert imports.demand(1, CMD, 0.0, wanted=True) == []


def test_a_changed_type_is_retracted_and_published_anew(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    assert imports.advertised(1, Advertise(added=(TopicOffer("/cmd", "/joy", "a/B"),))) == [
        Retract(1, CMD),
        Publish(1, CMD, "a/B"),
    ]


def test_another_type_than_the_local_one_is_refused_at_both_ends(imports: Imports) -> None:
    imports.local_type("/cmd", "std_msgs/String")
    warn, told = imports.advertised(1, Advertise(added=(OFFER,)))
    assert isinstance(warn, Warn)
    assert "std_msgs/String" in warn.text
    assert "sensor_msgs/Joy" in warn.text
    assert isinstance(told, Send)
    assert isinstance(told.message, Mismatch)
    assert imports.demand(1, CMD, 0.0, wanted=False) == []
    over = Send(1, Mismatch("/cmd", "/joy", "", ""))
    assert imports.local_type("/cmd", None) == [Publish(1, CMD, "sensor_msgs/Joy"), over]
    retract, *loud = imports.local_type("/cmd", "std_msgs/String")
    assert retract == Retract(1, CMD)
    assert [type(action) for action in loud] == [Warn, Send]


def test_a_publisher_with_another_type_than_offered_is_not_described(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER,)))
    imports.demand(1, CMD, 0.0, wanted=True)
    odd = Description("a/B", "5a9ea5f83505693b71e785041e67a8bb", "", False)
    actions = imports.opened(1, RouteOpened(1, odd), 0.0)
    assert [type(action) for action in actions] == [Send, Warn, Detach]
    assert state(imports) == "waiting"


def many(count: int) -> tuple[TopicOffer, ...]:
    return tuple(TopicOffer(f"/t{index:04}", "/n", "a/B") for index in range(count))


def test_many_timers_are_dealt_with_a_few_at_a_time(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=many(50)))
    for route, offer in enumerate(many(50), 1):
        imports.demand(1, offer.source, 0.0, wanted=True)
        imports.closed(1, RouteClosed(route, "it closed the connection"), 0.0)
    rounds = 0
    while (due := imports.next_timer()) is not None and due <= 6.0:
        assert len(imports.handle_timer(6.0)) <= 48
        rounds += 1
    assert rounds > 3
    assert {entry.state for entry in imports} == {"opening"}


def test_what_changes_while_somebody_looks_does_no_harm(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=many(3)))
    seen = []
    for entry in imports:
        source = entry.wire
        seen.append(source)
        imports.advertised(1, Advertise(added=(OFFER,), removed=(source,)))
    assert len(seen) == 3


def test_a_peer_that_nothing_waits_for_leaves_what_was_open(imports: Imports) -> None:
    imports.advertised(1, Advertise(added=(OFFER, *many(20))))
    imports.demand(1, CMD, 0.0, wanted=True)
    imports.opened(1, RouteOpened(1, ABOUT), 0.0)
    assert not imports.waits_for(1)
    assert imports.detached(1) == [Detach(1, CMD, 1, missed=True)]
    assert imports.detached(1) == []
    assert len(imports.book.gone(1)) >= 21


# --- contracts, and links that come back --------------------------------------------------------------------------

SURE = Contract(reliability=Reliability.RELIABLE)
OPENED = RouteOpened(1, ABOUT, SURE, epoch=5, first=1)
ODOM = TopicOffer("/odom", "/base", "a/B")


Positions = dict[tuple[int, Source], tuple[int, int]]
"""What the data path says of reliable routes that outlived their links."""


@pytest.fixture
def positions() -> Positions:
    return {}


@pytest.fixture
def flowing(positions: Positions) -> Imports:
    """Of peer 1, /cmd flows reliably by route 1 and /odom by best effort by route 2; both are listened to."""
    rules = Contracts((ContractRule(("/cmd",), (), {"reliability": Reliability.RELIABLE}),))
    machine = Imports(Policy(PolicySettings()), lambda: 1.0, rules, lambda *place: positions.get(place))
    machine.link_up(1)
    machine.advertised(1, Advertise(added=(OFFER, ODOM), full=True))
    machine.demand(1, CMD, 0.0, wanted=True)
    machine.demand(1, ODOM.source, 0.0, wanted=True)
    machine.opened(1, OPENED, 0.0)
    machine.opened(1, RouteOpened(2, Description("a/B", ABOUT.md5, "", False)), 0.0)
    return machine


def opens(actions: list[Any]) -> list[OpenRoute]:
    return [a.message for a in actions if isinstance(a, Send) and isinstance(a.message, OpenRoute)]


def test_our_contract_is_asked_for_and_what_holds_is_what_was_answered() -> None:
    rules = Contracts((ContractRule(("/cmd",), (), {"depth": 5}),))
    machine = Imports(Policy(PolicySettings()), lambda: 1.0, rules)
    machine.link_up(1)
    machine.advertised(1, Advertise(added=(OFFER,)))
    assert machine.demand(1, CMD, 0.0, wanted=True) == [Send(1, OpenRoute(1, "/cmd", "/joy", Contract(depth=5)))]
    holds = Contract(depth=7, reliability=Reliability.RELIABLE)
    assert machine.opened(1, RouteOpened(1, ABOUT, holds, epoch=3, first=12), 0.0) == [
        Describe(1, CMD, 1, ABOUT, holds, 3, 12)
    ]
    entry = machine.entry(1, CMD)
    assert entry.contract == holds


def test_another_transport_alone_leaves_routes_open(flowing: Imports) -> None:
    rule = ContractRule(("/cmd",), (), {"reliability": Reliability.RELIABLE})
    changed = ContractRule(("/cmd",), (), {"reliability": Reliability.RELIABLE, "depth": 5})

    def applied(rules: Contracts) -> list[Any]:
        return [a for some in flowing.apply_rules(Policy(PolicySettings()), rules, Names(), 0.0) for a in some]

    assert applied(Contracts((rule,), Transport.AUTO)) == []
    assert applied(Contracts((rule,), Transport.DIRECT)) == []
    (asked,) = opens(applied(Contracts((changed,), Transport.DIRECT)))
    assert asked.contract == Contract(reliability=Reliability.RELIABLE, depth=5, transport=Transport.DIRECT)


def test_only_what_is_reliable_and_listened_to_waits_for_its_peer(flowing: Imports) -> None:
    flowing.advertised(1, Advertise(added=(TopicOffer("/idle", "/base", "a/B"),)))
    assert flowing.link_away(1) == (
        [
            Detach(1, CMD, 1, keep=True),
            Detach(1, ODOM.source, 2, missed=True),
            Retract(1, ODOM.source),
            Retract(1, Source("/idle", "/base")),
        ],
        True,
    )
    assert state(flowing) == "waiting"
    assert flowing.next_timer() is None, "nobody is there to be asked"
    flowing.link_down(1)
    assert flowing.get(1, CMD) is None


def test_back_it_goes_on_behind_what_came(flowing: Imports, positions: Positions) -> None:
    flowing.link_away(1)
    flowing.link_up(1)
    positions[1, CMD] = (5, 41)
    assert flowing.next_timer() is None, "it may not be offered any more"
    actions = flowing.advertised(1, Advertise(added=(OFFER, ODOM)), 10.0)
    assert opens(actions) == [OpenRoute(1, "/cmd", "/joy", SURE, epoch=5, after=41)]
    assert Publish(1, ODOM.source, "a/B") in actions
    assert Publish(1, CMD, OFFER.type) not in actions, "it never left"
    assert flowing.opened(1, OPENED, 10.0) == [Describe(1, CMD, 1, ABOUT, SURE, 5, 1)]
    assert state(flowing) == "open"


@pytest.mark.parametrize("moment", ["before_its_offer", "while_asking"])
def test_a_second_loss_changes_nothing(flowing: Imports, positions: Positions, moment: str) -> None:
    positions[1, CMD] = (5, 41)
    flowing.link_away(1)
    flowing.link_up(1)
    if moment == "while_asking":
        flowing.advertised(1, Advertise(added=(OFFER,)), 10.0)
    actions, waits = flowing.link_away(1)
    assert waits
    assert actions == ([Detach(1, CMD, 1, keep=True)] if moment == "while_asking" else [])
    flowing.link_up(1)
    assert flowing.next_timer() is None
    actions = flowing.advertised(1, Advertise(added=(OFFER,)), 20.0)
    assert opens(actions) == [OpenRoute(1, "/cmd", "/joy", SURE, epoch=5, after=41)]


def test_what_is_offered_no_more_goes_when_the_whole_offer_is_there(flowing: Imports) -> None:
    flowing.link_away(1)
    flowing.link_up(1)
    [(wire, offer)] = flowing.changes(1, Advertise(added=(ODOM,), full=True, more=True))
    assert flowing.take_in(1, wire, offer, 10.0) == [Publish(1, ODOM.source, "a/B")]
    assert state(flowing) == "waiting"
    assert flowing.advertised(1, Advertise(), 10.0) == [Detach(1, CMD, 0, missed=True), Retract(1, CMD)]


def test_a_peer_that_is_back_is_no_problem_any_more(flowing: Imports) -> None:
    flowing.demand(1, CMD, 0.0, wanted=False)
    flowing.demand(1, ODOM.source, 0.0, wanted=False)
    entries = [flowing.get(1, source) for source in (CMD, ODOM.source)]
    flowing.link_away(1, briefly=True)
    assert {entry.problem for entry in entries if entry} == {"its peer is away"}
    flowing.link_up(1)
    flowing.advertised(1, Advertise(added=(OFFER, ODOM)), 10.0)
    assert {entry.problem for entry in entries if entry} == {""}


@pytest.mark.parametrize("again", [False, True])
def test_who_leaves_while_the_peer_is_away_ends_what_waits_and_who_comes_is_served_later(
    flowing: Imports, again: bool
) -> None:
    flowing.link_away(1)
    assert flowing.demand(1, CMD, 1.0, wanted=False) == [Detach(1, CMD, 0)]
    assert state(flowing) == "idle"
    if again:
        assert flowing.demand(1, CMD, 2.0, wanted=True) == []
        assert (state(flowing), flowing.next_timer()) == ("waiting", None)
    flowing.link_up(1)
    actions = flowing.advertised(1, Advertise(added=(OFFER,)), 10.0)
    actions = actions if again else actions + flowing.demand(1, CMD, 11.0, wanted=True)
    assert opens(actions) == [OpenRoute(1, "/cmd", "/joy", SURE)]


def test_a_short_silence_leaves_everything_where_it_is(flowing: Imports, positions: Positions) -> None:
    flowing.advertised(1, Advertise(added=(TopicOffer("/idle", "/base", "a/B"), TopicOffer("/left", "/base", "a/B"))))
    left = Source("/left", "/base")
    flowing.demand(1, left, 0.0, wanted=True)
    flowing.opened(1, RouteOpened(3, Description("a/B", ABOUT.md5, "", False)), 0.0)
    flowing.demand(1, left, 0.0, wanted=False)
    assert flowing.link_away(1, briefly=True) == (
        [Detach(1, CMD, 1, keep=True), Detach(1, ODOM.source, 2, keep=True), Detach(1, left, 3)],
        True,
    )
    assert flowing.next_timer() is None
    flowing.link_up(1)
    positions[1, CMD] = (5, 41)
    offers = (OFFER, ODOM, TopicOffer("/idle", "/base", "a/B"), TopicOffer("/left", "/base", "a/B"))
    actions = flowing.advertised(1, Advertise(added=offers), 10.0)
    assert opens(actions) == [
        OpenRoute(1, "/cmd", "/joy", SURE, epoch=5, after=41),
        OpenRoute(2, "/odom", "/base"),
    ]
    assert len(actions) == 2, "nothing appears and nothing leaves"


def test_what_is_latched_waits_for_a_silent_peer_while_somebody_listens(imports: Imports) -> None:
    latched = Description("sensor_msgs/Joy", ABOUT.md5, "Header header\n", True)
    plain = Description("a/B", ABOUT.md5, "", False)
    imports.advertised(1, Advertise(added=(OFFER, ODOM)))
    for route, (source, about) in enumerate(((CMD, latched), (ODOM.source, plain)), start=1):
        imports.demand(1, source, 0.0, wanted=True)
        imports.opened(1, RouteOpened(route, about), 0.0)
    imports.link_away(1, briefly=True)
    assert imports.waits_for(1)
    assert imports.link_away(1) == ([Retract(1, ODOM.source)], True)
    imports.link_up(1)
    assert opens(imports.advertised(1, Advertise(added=(OFFER,)), 10.0)) == [OpenRoute(1, "/cmd", "/joy")]
    imports.opened(1, RouteOpened(1, latched), 10.0)
    # A link that somebody closed is not expected back.
    assert imports.link_away(1) == ([Detach(1, CMD, 1, missed=True), Retract(1, CMD)], False)


def test_a_local_topic_of_another_type_ends_what_waits(flowing: Imports) -> None:
    flowing.link_away(1)
    actions = flowing.local_type("/cmd", "std_msgs/String")
    assert actions[:2] == [Detach(1, CMD, 0), Retract(1, CMD)]
    flowing.link_up(1)
    assert opens(flowing.advertised(1, Advertise(added=(OFFER,)), 10.0)) == []
