from __future__ import annotations

from typing import Any

import pytest

from rmpa.bridge.messages import (
    Advertise,
    CloseRoute,
    Description,
    OpenRoute,
    RouteClosed,
    RouteOpened,
    Source,
    TopicOffer,
)
from rmpa.bridge.policy import Names, Policy
from rmpa.bridge.topics.exports import LocalSource
from rmpa.config.peer_rules import PolicySettings
from rmpa.config.settings import LimitSettings
from rmpa.core.contract import Contract, ContractRule, Contracts, Reliability, Transport
from tests.bridge.recorder import AddRoute, Connect, Disconnect, Exports, RemoveRoute, Send, Warn

CMD = Source("/cmd", "/joy")
JOY = LocalSource("sensor_msgs/Joy", "http://127.0.0.1:4000/")
ABOUT = Description("sensor_msgs/Joy", "5a9ea5f83505693b71e785041e67a8bb", "Header header\n", False)


def graph(exports: Exports, sources: dict[Source, LocalSource]) -> list[Any]:
    """Say all that the local graph has, and what the peers are told of it."""
    actions = []
    for topic in sorted({*exports.topics, *(source.topic for source in sources)}):
        actions += exports.graph(topic, {s.node: local for s, local in sources.items() if s.topic == topic})
    while exports.pending:
        actions += exports.advertise()
    return actions


@pytest.fixture
def exports() -> Exports:
    return Exports(Policy(PolicySettings(deny=("/secret",))))


@pytest.fixture
def offering(exports: Exports) -> Exports:
    """/cmd is offered to peer 1."""
    graph(exports, {CMD: JOY})
    exports.link_up(1)
    return exports


def test_a_new_link_is_told_all_that_policy_lets_cross(exports: Exports) -> None:
    graph(
        exports,
        {
            CMD: JOY,
            Source("/secret", "/joy"): JOY,
            Source("/rosout", "/joy"): LocalSource("rosgraph_msgs/Log", "http://127.0.0.1:4000/"),
            Source("/odd", "/joy"): LocalSource("*", "http://127.0.0.1:4000/"),
            Source("/no name", "/joy"): JOY,
            Source("/cmd", "no_node"): JOY,
            Source("/" + "x" * 1024, "/n"): JOY,
            Source("/a//b", "/n"): JOY,
        },
    )
    assert exports.link_up(1) == [
        Send(1, Advertise(added=(TopicOffer("/cmd", "/joy", "sensor_msgs/Joy"),), full=True)),
    ]


def test_a_lost_publisher_closes_every_route_and_forgets_them(offering: Exports) -> None:
    offering.opened(1, OpenRoute(7, "/cmd", "/joy"))
    offering.described(CMD, ABOUT)
    assert offering.lost(CMD, "it closed the connection") == [
        RemoveRoute(CMD, 1, 7), Disconnect(CMD), Send(1, RouteClosed(7, "it closed the connection")),
    ]  # fmt: skip
    assert offering.lost(CMD, "it closed the connection") == []
    assert offering.closed(1, CloseRoute(7)) == []
    assert offering.opened(1, OpenRoute(7, "/cmd", "/joy")) == [Connect(CMD, JOY.uri)]


def test_a_route_opened_twice_is_ignored_and_said(offering: Exports) -> None:
    offering.opened(1, OpenRoute(7, "/cmd", "/joy"))
    [action] = offering.opened(1, OpenRoute(7, "/cmd", "/joy"))
    assert isinstance(action, Warn)


def test_a_peer_gets_one_copy_of_a_source_however_often_it_asks(offering: Exports) -> None:
    offering.opened(1, OpenRoute(7, "/cmd", "/joy"))
    for route in (8, 9):
        [action] = offering.opened(1, OpenRoute(route, "/cmd", "/joy"))
        assert isinstance(action, Send)
        assert isinstance(action.message, RouteClosed)
        assert action.message.route == route
    assert offering.described(CMD, ABOUT) == [
        Send(1, RouteOpened(7, ABOUT, epoch=1)),
        AddRoute(CMD, 1, 7, Contract(), 1),
    ]
    offering.closed(1, CloseRoute(7))
    assert offering.opened(1, OpenRoute(10, "/cmd", "/joy")) == [Connect(CMD, JOY.uri)]


def test_the_number_of_routes_is_bounded() -> None:
    exports = Exports(Policy(PolicySettings()), limit_settings=LimitSettings(topics=1))
    graph(exports, {CMD: JOY})
    exports.link_up(1)
    exports.opened(1, OpenRoute(7, "/cmd", "/joy"))
    [action] = exports.opened(1, OpenRoute(8, "/cmd", "/joy"))
    assert isinstance(action, Send)
    assert isinstance(action.message, RouteClosed)


# --- contracts, and links that come back --------------------------------------------------------------------------

RELIABLE = Contract(reliability=Reliability.RELIABLE)
SURE = OpenRoute(7, "/cmd", "/joy", RELIABLE)


def sends(actions: list[Any]) -> list[object]:
    return [action.message for action in actions if isinstance(action, Send)]


@pytest.fixture
def flowing(offering: Exports) -> Exports:
    """/cmd flows reliably to peer 1, by epoch 1."""
    offering.opened(1, SURE)
    offering.described(CMD, ABOUT)
    return offering


def test_another_transport_alone_leaves_routes_open(flowing: Exports) -> None:
    policy, asked = Policy(PolicySettings()), Contract(reliability=Reliability.RELIABLE, transport=Transport.AUTO)
    flowing.link_up(2)
    flowing.opened(2, OpenRoute(7, "/cmd", "/joy", asked))
    assert flowing.apply_rules(policy, Contracts((), Transport.AUTO), Names()) == []
    assert flowing.flowing(CMD) == (1, 2)
    assert [flowing.contract(CMD, peer) for peer in (1, 2)] == [RELIABLE, asked]
    slower = Contracts((ContractRule((), (), {"max_rate": 5.0}),), Transport.AUTO)
    assert [type(message) for message in sends(flowing.apply_rules(policy, slower, Names()))] == [RouteClosed] * 2


def test_what_the_peer_asked_for_again_is_claimed(flowing: Exports) -> None:
    flowing.link_up(2)
    flowing.opened(2, SURE)
    for peer in (1, 2):
        flowing.link_away(peer)
    flowing.link_up(1)
    flowing.opened(1, OpenRoute(1, "/cmd", "/joy", RELIABLE, epoch=1, after=0))
    assert flowing.given_up(CMD, 1) == []
    assert flowing.flowing(CMD) == (1,)
    assert flowing.link_down(2) == [RemoveRoute(CMD, 2, 0)]
