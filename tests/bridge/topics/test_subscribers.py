from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, ClassVar, cast

import pytest

from rmpa.bridge import limits
from rmpa.bridge.messages import (
    Advertise,
    Audience,
    CloseRoute,
    Description,
    Mismatch,
    OpenRoute,
    Origin,
    RouteClosed,
    RouteOpened,
    Source,
    TopicOffer,
)
from rmpa.bridge.policy import OPEN_GATE, PermissionGate, Policy
from rmpa.bridge.sessions import PeerSession
from rmpa.bridge.topics import exports as module
from rmpa.bridge.topics.exports import LocalSource
from rmpa.bridge.topics.import_route import ImportRoute, RemoteTopic
from rmpa.bridge.topics.reports import Mismatches, audience
from rmpa.config.peer_rules import PermissionRule, PolicySettings
from rmpa.config.settings import TrustSettings
from rmpa.trust.permissions import Permissions
from tests.bridge.recorder import Exports, Imports, Send, Warn

# Who listens is told to the peer that publishes; whom a peer tells of is connected to our publisher.


GOAL = Source("/count/goal", "/client")


CHATTER = Source("/chatter", "/client")


TYPE = "actionlib/TestActionGoal"


GOAL_OFFER = TopicOffer("/count/goal", "/client", TYPE)


MD5 = "5a9ea5f83505693b71e785041e67a8bb"


URI = "http://client:1/"


class Connection:
    """A connection to a local publisher that is only noted."""

    made: ClassVar[list[Connection]] = []

    def __init__(
        self, topic: str, uri: str, caller_id: str, *, on_message: Callable[[memoryview], None], on_parts: object
    ) -> None:
        assert on_parts is not None, "a large goal would be kept"
        on_message(memoryview(b"what comes is dropped"))
        self.what = (topic, uri, caller_id)
        self.running = False
        self.made.append(self)

    def start(self) -> None:
        self.running = True

    def close(self) -> None:
        self.running = False


def connected() -> list[str]:
    """Under which names we are connected."""
    return sorted(one.what[2] for one in Connection.made if one.running)


class Route(ImportRoute):
    """A source at its proxy, without the proxy."""

    def __init__(self, part: Any, entry: RemoteTopic) -> None:
        self._part, self.entry = part, entry
        self._told, self._telling = (), None
        self.flow = cast("Any", "there")

    def open(self, _opened: RouteOpened) -> None:
        self._told = ()


class World:
    """The plans of one bridge, and one peer."""

    def __init__(self, gate: PermissionGate = OPEN_GATE) -> None:
        policy = Policy(PolicySettings())
        self.exports, self.imports = Exports(policy, gate=gate), Imports(policy, lambda: 0.5, gate=gate)
        self.sent: list[object] = []
        self.warned: list[str] = []
        link = SimpleNamespace(name="base")
        proxies = SimpleNamespace(prefix="/rmpa/base")
        self.peer = cast("PeerSession", SimpleNamespace(peer=1, link=link, proxies=proxies))
        self.part = SimpleNamespace(
            send=lambda _peer, message: self.sent.append(message),
            direct_imports=SimpleNamespace(listeners_changed=lambda *_: None),
        )
        cast("Any", self.exports.out).imports = self.imports
        self.exports.link_up(1, "base" if gate.on else "")
        self.imports.link_up(1)

    def change(self, source: Source, *listeners: str) -> None:
        """These listen to a source of the peer now."""
        if (entry := self.imports.get(1, source)) is not None:
            if not isinstance(entry.route, Route):
                entry.route = Route(self.part, entry)
            entry.route.publication = SimpleNamespace(listeners=listeners)
            entry.route.listeners_changed()

    async def changed(self, source: Source, *listeners: str) -> list[object]:
        """Likewise; return what the peer was told."""
        self.change(source, *listeners)
        await asyncio.sleep(0)
        sent, self.sent = self.sent, []
        return sent

    def publish(self, source: Source, type_name: str, route: int) -> None:
        """A source of ours that the peer has open."""
        self.exports.graph(source.topic, {source.node: LocalSource(type_name, URI)})
        self.exports.advertise()
        self.exports.opened(1, OpenRoute(route, source.topic, source.node))
        self.exports.described(source, Description(type_name, MD5, "", False))

    def told(self, route: int, *nodes: str) -> list[str]:
        """The peer says who listens; return under which names we are connected then."""
        done = self.exports.named(self.peer, Audience(route, nodes))
        self.warned += [one.kind for one in done if isinstance(one, Warn)]
        return connected()


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    monkeypatch.setattr(module, "PublisherConnection", Connection)
    monkeypatch.setattr(Connection, "made", [])
    return World()


# --- our listeners ----------------------------------------------------------------------------------------------


async def test_listeners_are_told_once_the_route_is_open_and_when_they_change(world: World) -> None:
    world.imports.advertised(1, Advertise(added=(GOAL_OFFER,)))
    world.imports.demand(1, GOAL, 0.0, wanted=True)
    assert await world.changed(GOAL, "/server") == [], "it is not open yet"
    world.imports.opened(1, RouteOpened(1, Description(TYPE, MD5, "", False)), 0.0)
    assert await world.changed(GOAL, "/server") == [Audience(1, ("/server",))]
    assert await world.changed(GOAL, "/server") == [], "that is known"
    assert await world.changed(GOAL, "/server", "/echo") == [Audience(1, ("/echo", "/server"))]
    world.imports.demand(1, GOAL, 1.0, wanted=False)
    assert await world.changed(GOAL) == [Audience(1, ())], "while the route lingers"
    # A new route begins with nobody.
    world.imports.closed(1, RouteClosed(1, "restarted"), 2.0)
    assert await world.changed(GOAL) == []
    world.imports.demand(1, GOAL, 3.0, wanted=True)
    world.imports.opened(1, RouteOpened(2, Description(TYPE, MD5, "", False)), 3.0)
    assert await world.changed(GOAL, "/server") == [Audience(2, ("/server",))]


# --- the peer's listeners ---------------------------------------------------------------------------------------


async def test_each_is_connected_under_its_name_here_until_it_leaves(world: World) -> None:
    world.publish(GOAL, TYPE, 7)
    assert world.told(7, "/server", "/echo") == ["/rmpa/base/echo", "/rmpa/base/server"]
    assert [one.what[:2] for one in Connection.made] == [("/count/goal", URI)] * 2
    assert world.told(7, "/server") == ["/rmpa/base/server"]
    assert list(world.exports.routes(GOAL)[1].audience) == ["/rmpa/base/server"]
    assert len(Connection.made) == 2, "who stays is not connected anew"
    assert world.told(7) == []


async def test_what_does_not_belong_is_left_alone(world: World) -> None:
    world.publish(CHATTER, "std_msgs/String", 8)
    assert world.told(8, "/listener") == [], "its publisher does not look"
    assert world.told(9, "/server") == [], "no such route"
    world.publish(GOAL, TYPE, 7)
    world.exports.closed(1, CloseRoute(7))
    assert world.told(7, "/server") == [], "closed meanwhile"


async def test_a_peer_can_make_us_connect_so_often_and_no_more(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "AUDIENCES_MAX", 3)
    world.publish(GOAL, TYPE, 7)
    assert len(world.told(7, "/a", "/b", "/c", "/d")) == 3
    assert world.warned == ["audience.too_many"]


def test_listeners_behind_a_relay_are_named_only_if_both_may(world: World) -> None:
    goal_of_arm = TopicOffer("/x", "/n", TYPE, Origin("arm", "10.0.0.3:1#0", "3" * 32, "/n", ("2" * 32,)))
    rule = PermissionRule(("arm", "base"), names={"subscribe": ("/count/goal",)})
    for trust, expected in (
        (TrustSettings(rules=(rule,), relays=("base",)), ["/rmpa/arm/server", "/rmpa/base/own"]),
        (TrustSettings(rules=(rule,)), ["/rmpa/base/own"]),
        (TrustSettings(rules=(replace(rule, modules=("base",)),), relays=("base",)), ["/rmpa/base/own"]),
    ):
        Connection.made.clear()
        secured = World(PermissionGate(Permissions(trust)))
        secured.imports.link_up(1, "base", "2" * 32, 2)
        secured.imports.advertised(1, Advertise(added=(goal_of_arm,)))
        secured.publish(GOAL, TYPE, 7)
        assert secured.told(7, "/own", "/rmpa/arm/server", "/rmpa/leg/server") == expected


def test_nodes_are_named_once_in_order_and_nobody_else() -> None:
    caller_ids = ("/b", "/a", "/b", "/rmpa", "/rmpa/peer/node", "no name", "", "/line\nfeed", "/" + "x" * 2000)
    # What stands for other modules is named where we relay: nothing else of theirs listens to a proxy.
    assert audience(caller_ids) == ("/a", "/b", "/rmpa/peer/node")
    assert len(audience(f"/n{number}" for number in range(1000))) == limits.AUDIENCE_MAX


# What a mismatch of definitions says here, and what the agent at the other end hears of it.


CMD = Source("/cmd", "/joy")


BASE = 1


class Reports(Mismatches):
    """Reports of a module that offers ``/cmd`` to the peer *base*, or has it of that peer."""

    def __init__(self) -> None:
        self.done: list[Any] = []
        self.warnings: list[str] = []
        self.offered = {CMD}
        exports = SimpleNamespace(
            offered=self.offered, local=lambda _peer, source: source if source in self.offered else None
        )
        entry = SimpleNamespace(peer=BASE, wire=CMD, node=CMD.node)
        imports = SimpleNamespace(at=lambda topic: [entry] if topic == CMD.topic else [], knows=lambda _: False)
        out = SimpleNamespace(
            send=lambda peer, message: self.done.append(Send(peer, message)),
            warn=lambda *args: self.warnings.append(args[2]),
            exports=exports,
            imports=imports,
        )
        super().__init__(cast("Any", out))

    def hear(self, text: str, subscriber: str = "/viewer") -> None:
        self.reported(BASE, "base", Mismatch(CMD.topic, CMD.node, subscriber, text))


@pytest.fixture
def reports() -> Reports:
    return Reports()


def test_a_refused_subscriber_is_told_to_the_peer_until_it_registers_again(reports: Reports) -> None:
    reports.refused(BASE, CMD, "/viewer", "other md5")
    reports.registration_changed("/cmd", "/recorder")
    assert (reports.texts(CMD), reports.warnings) == (("other md5",), ["other md5"])
    assert reports.done == [Send(BASE, Mismatch("/cmd", "/joy", "/viewer", "other md5"))]
    reports.done.clear()
    for _ in range(2):
        reports.registration_changed("/cmd", "/viewer")
    assert reports.texts(CMD) == ()
    assert reports.done == [Send(BASE, Mismatch("/cmd", "/joy", "/viewer", ""))]


def test_a_peers_report_ends_with_an_empty_text_or_with_the_peer(reports: Reports) -> None:
    reports.hear("other md5")
    reports.hear("")
    assert reports.texts(CMD) == ()
    reports.hear("other md5")
    reports.peer_gone("base")
    assert reports.texts(CMD) == ()
    assert len(reports.warnings) == 2, "an end is no warning"


def test_a_source_has_only_so_many_and_each_of_them_can_still_change(reports: Reports) -> None:
    for number in range(limits.MISMATCHES_MAX + 5):
        reports.hear("other md5", f"/n{number}")
    assert len(reports.texts(CMD)) == limits.MISMATCHES_MAX
    reports.hear("changed", "/n0")
    assert reports.texts(CMD)[0] == "changed"


def test_a_source_that_is_gone_has_no_mismatches(reports: Reports) -> None:
    reports.hear("other md5")
    reports.forget_gone()
    assert reports.texts(CMD) == ("other md5",)
    reports.offered.clear()
    reports.forget_gone()
    assert reports.texts(CMD) == ()
    reports.hear("late")
    assert reports.texts(CMD) == (), "the report crossed the withdrawal"
