from __future__ import annotations

import pytest

from rmpa.bridge.actions import Action, AddRoute, Connect, Disconnect, RemoveRoute, Send, Warn
from rmpa.bridge.exports import Exports, LocalSource
from rmpa.bridge.messages import Advertise, Close, Closed, Description, Offer, Open, Opened, Source
from rmpa.bridge.policy import Decision, Policy
from rmpa.core import limits
from rmpa.core.config import PolicySettings
from rmpa.core.contract import Contract

CMD = Source("/cmd", "/joy")
JOY = LocalSource("sensor_msgs/Joy", "http://127.0.0.1:4000/")
ABOUT = Description("sensor_msgs/Joy", "5a9ea5f83505693b71e785041e67a8bb", "Header header\n", False)


def graph(exports: Exports, sources: dict[Source, LocalSource]) -> list[Action]:
    """Say all that the local graph has, and what the peers are told of it."""
    actions = []
    for topic in sorted({*exports.topics, *(source.topic for source in sources)}):
        actions += exports.graph(topic, {s.node: local for s, local in sources.items() if s.topic == topic})
    while exports.untold:
        actions += exports.tell()
    return actions


@pytest.fixture
def exports() -> Exports:
    return Exports(Policy(PolicySettings(deny=("/secret",))))


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
        },
    )
    assert exports.link_up(1) == [
        Send(1, Advertise(added=(Offer("/cmd", "/joy", "sensor_msgs/Joy"),), full=True)),
    ]


def test_names_that_no_peer_would_take_stay_home(exports: Exports) -> None:
    graph(exports, {Source("/" + "x" * 1024, "/n"): JOY, Source("/a//b", "/n"): JOY, CMD: JOY})
    assert set(exports.offered) == {CMD}


def test_changes_are_told_to_every_link_and_only_changes(exports: Exports) -> None:
    exports.link_up(1)
    exports.link_up(2)
    change = Advertise(added=(Offer("/cmd", "/joy", "sensor_msgs/Joy"),))
    assert graph(exports, {CMD: JOY}) == [Send(1, change), Send(2, change)]
    assert graph(exports, {CMD: JOY}) == []
    assert graph(exports, {}) == [Send(1, Advertise(removed=(CMD,))), Send(2, Advertise(removed=(CMD,)))]


def test_a_changed_type_is_offered_again_and_a_changed_address_is_not(exports: Exports) -> None:
    exports.link_up(1)
    graph(exports, {CMD: JOY})
    assert graph(exports, {CMD: LocalSource("sensor_msgs/Joy", "http://127.0.0.1:5000/")}) == []
    assert graph(exports, {CMD: LocalSource("std_msgs/Empty", "http://127.0.0.1:5000/")}) == [
        Send(1, Advertise(added=(Offer("/cmd", "/joy", "std_msgs/Empty"),)))
    ]


def test_nothing_is_connected_before_somebody_asks_and_one_connection_serves_all(exports: Exports) -> None:
    graph(exports, {CMD: JOY})
    exports.link_up(1)
    exports.link_up(2)
    assert exports.opened(1, Open(7, "/cmd", "/joy")) == [Connect(CMD, JOY.type, JOY.uri)]
    assert exports.opened(2, Open(9, "/cmd", "/joy")) == []
    assert exports.described(CMD, ABOUT) == [
        Send(1, Opened(7, ABOUT)),
        AddRoute(CMD, 1, 7, Contract()),
        Send(2, Opened(9, ABOUT)),
        AddRoute(CMD, 2, 9, Contract()),
    ]
    assert exports.flowing(CMD) == (1, 2)
    assert exports.closed(1, Close(7)) == [RemoveRoute(CMD, 1, 7)]
    assert exports.closed(2, Close(9)) == [RemoveRoute(CMD, 2, 9), Disconnect(CMD)]
    assert exports.flowing(CMD) == ()


def test_a_late_peer_gets_the_known_description_at_once(exports: Exports) -> None:
    graph(exports, {CMD: JOY})
    exports.link_up(1)
    exports.link_up(2)
    exports.opened(1, Open(1, "/cmd", "/joy"))
    exports.described(CMD, ABOUT)
    assert exports.opened(2, Open(1, "/cmd", "/joy")) == [Send(2, Opened(1, ABOUT)), AddRoute(CMD, 2, 1, Contract())]


@pytest.mark.parametrize("topic", ["/nothing", "/secret", "/rosout"])
def test_what_is_not_offered_is_not_opened(exports: Exports, topic: str) -> None:
    graph(exports, {Source(topic, "/joy"): JOY} if topic != "/nothing" else {})
    exports.link_up(1)
    [action] = exports.opened(1, Open(7, topic, "/joy"))
    assert isinstance(action, Send)
    assert isinstance(action.message, Closed)
    assert "policy" in action.message.reason


def test_a_lost_publisher_closes_every_route_and_forgets_them(exports: Exports) -> None:
    graph(exports, {CMD: JOY})
    exports.link_up(1)
    exports.opened(1, Open(7, "/cmd", "/joy"))
    exports.described(CMD, ABOUT)
    assert exports.lost(CMD, "it hung up") == [RemoveRoute(CMD, 1, 7), Send(1, Closed(7, "it hung up"))]
    assert exports.lost(CMD, "it hung up") == []
    assert exports.closed(1, Close(7)) == []
    assert exports.opened(1, Open(7, "/cmd", "/joy")) == [Connect(CMD, JOY.type, JOY.uri)]


def test_a_restarted_node_is_left_at_its_old_address(exports: Exports) -> None:
    graph(exports, {CMD: JOY})
    exports.link_up(1)
    exports.opened(1, Open(7, "/cmd", "/joy"))
    exports.described(CMD, ABOUT)
    assert graph(exports, {CMD: LocalSource(JOY.type, "http://127.0.0.1:5000/")}) == [
        RemoveRoute(CMD, 1, 7),
        Send(1, Closed(7, "the node has restarted")),
        Disconnect(CMD),
    ]


def test_a_link_that_falls_takes_its_routes_along(exports: Exports) -> None:
    graph(exports, {CMD: JOY})
    exports.link_up(1)
    exports.link_up(2)
    exports.opened(1, Open(7, "/cmd", "/joy"))
    exports.opened(2, Open(7, "/cmd", "/joy"))
    exports.described(CMD, ABOUT)
    assert exports.link_down(1) == [RemoveRoute(CMD, 1, 7)]
    assert exports.link_down(2) == [RemoveRoute(CMD, 2, 7), Disconnect(CMD)]
    assert exports.link_down(2) == []


def test_a_route_opened_twice_is_ignored_and_said(exports: Exports) -> None:
    graph(exports, {CMD: JOY})
    exports.link_up(1)
    exports.opened(1, Open(7, "/cmd", "/joy"))
    [action] = exports.opened(1, Open(7, "/cmd", "/joy"))
    assert isinstance(action, Warn)


def test_a_peer_gets_one_copy_of_a_source_however_often_it_asks(exports: Exports) -> None:
    graph(exports, {CMD: JOY})
    exports.link_up(1)
    exports.opened(1, Open(7, "/cmd", "/joy"))
    for route in (8, 9):
        [action] = exports.opened(1, Open(route, "/cmd", "/joy"))
        assert isinstance(action, Send)
        assert isinstance(action.message, Closed)
        assert action.message.route == route
    assert exports.described(CMD, ABOUT) == [Send(1, Opened(7, ABOUT)), AddRoute(CMD, 1, 7, Contract())]
    exports.closed(1, Close(7))
    assert exports.opened(1, Open(10, "/cmd", "/joy")) == [Connect(CMD, JOY.type, JOY.uri)]


def test_the_number_of_routes_is_bounded(exports: Exports, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "ROUTES_PER_LINK_MAX", 1)
    graph(exports, {CMD: JOY})
    exports.link_up(1)
    exports.opened(1, Open(7, "/cmd", "/joy"))
    [action] = exports.opened(1, Open(8, "/cmd", "/joy"))
    assert isinstance(action, Send)
    assert isinstance(action.message, Closed)


def test_too_many_sources_are_cut_and_said(exports: Exports, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "TOPICS_PER_PEER_MAX", 2)
    actions = graph(exports, {Source(f"/t{i}", "/n"): JOY for i in range(3)})
    assert [type(action) for action in actions] == [Warn]
    assert len(exports.offered) == 2


def many(count: int) -> dict[Source, LocalSource]:
    return {Source(f"/t{index:04}", "/n"): JOY for index in range(count)}


def test_a_large_graph_is_told_a_part_at_a_time(exports: Exports) -> None:
    graph(exports, many(200))
    actions = exports.link_up(1)
    exports.link_up(2)
    while exports.untold:
        told = exports.tell()
        assert len(told) <= 2
        actions += told
    messages = [action.message for action in actions if isinstance(action, Send) and action.peer == 1]
    assert all(isinstance(message, Advertise) for message in messages)
    assert [message.full for message in messages if isinstance(message, Advertise)] == [True, False, False, False]
    offers = [offer for message in messages if isinstance(message, Advertise) for offer in message.added]
    assert max(len(message.added) for message in messages if isinstance(message, Advertise)) == 64
    assert {offer.source for offer in offers} == set(many(200))
    assert len(offers) == 200


def test_what_came_and_went_before_it_was_told_is_not_told(exports: Exports) -> None:
    exports.link_up(1)
    exports.graph("/cmd", {"/joy": JOY})
    exports.graph("/cmd", {})
    assert exports.tell() == []
    graph(exports, {CMD: JOY})
    exports.graph("/cmd", {})
    exports.graph("/cmd", {"/joy": JOY})
    assert [exports.untold, exports.tell(), exports.untold] == [True, [], False]
    exports.graph("/cmd", {})
    exports.graph("/cmd", {"/joy": LocalSource("std_msgs/Empty", JOY.uri)})
    assert exports.tell() == [Send(1, Advertise(added=(Offer("/cmd", "/joy", "std_msgs/Empty"),)))]


def test_room_is_given_to_a_source_that_there_were_too_many_for(
    exports: Exports, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "TOPICS_PER_PEER_MAX", 2)
    exports.link_up(1)
    graph(exports, many(4))
    assert [source.topic for source in exports.offered] == ["/t0000", "/t0001"]
    exports.graph("/t0003", {})
    exports.graph("/t0000", {})
    assert [source.topic for source in exports.offered] == ["/t0001", "/t0002"]
    assert exports.tell() == [
        Send(1, Advertise(added=(Offer("/t0002", "/n", JOY.type),), removed=(Source("/t0000", "/n"),)))
    ]
    exports.graph("/t0001", {})
    exports.graph("/t0002", {})
    assert not exports.offered


def test_a_change_costs_what_changed_and_not_what_there_is(exports: Exports) -> None:
    """The judge is asked about the changed source alone, and the peers' messages hold nothing else."""
    exports.link_up(1)
    graph(exports, many(2000))
    asked: list[str] = []
    judge = exports._policy.judge

    def counting(topic: str, type_name: str, node: str) -> Decision:
        asked.append(topic)
        return judge(topic, type_name, node)

    exports._policy.judge = counting  # type: ignore[method-assign]
    assert exports.graph("/t0001", {"/n": JOY}) == []
    assert exports.graph("/t0001", {}) == []
    assert exports.graph("/t0001", {"/m": JOY}) == []
    assert exports.tell() == [
        Send(1, Advertise(added=(Offer("/t0001", "/m", JOY.type),), removed=(Source("/t0001", "/n"),)))
    ]
    assert asked == ["/t0001"]
