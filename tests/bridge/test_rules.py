"""Names and policy for single peers, and rules that change while routes are open."""

from __future__ import annotations

from collections import deque
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from rmpa.bridge.messages import (
    Advertise,
    CloseRoute,
    Description,
    OpenRoute,
    RouteClosed,
    RouteOpened,
    Source,
    TopicOffer,
    decode,
    encode,
)
from rmpa.bridge.policy import Names, Policy
from rmpa.bridge.topics.exports import LocalSource
from rmpa.config.peer_rules import PeerRule, PolicySettings
from rmpa.core.contract import ContractRule, Contracts
from tests.bridge.recorder import (
    AddRoute,
    Connect,
    Describe,
    Detach,
    Disconnect,
    Exports,
    Imports,
    Publish,
    RemoveRoute,
    Retract,
    Send,
    Warn,
)

TYPE = "a/B"
ABOUT = Description(TYPE, "5a9ea5f83505693b71e785041e67a8bb", "", False)
ROBOT = PeerRule("robot*", "/{peer}")
EVERYTHING = PolicySettings()


class Side:
    """The rules of one module."""

    def __init__(
        self, *peers: PeerRule, policy: PolicySettings = EVERYTHING, contracts: tuple[ContractRule, ...] = ()
    ) -> None:
        self.policy = Policy(policy, peers)
        self.contracts = Contracts(contracts)
        self.names = Names(peers)

    def exports(self) -> Exports:
        return Exports(self.policy, self.contracts, self.names)

    def imports(self) -> Imports:
        return Imports(self.policy, lambda: 0.5, self.contracts, names=self.names)


def offered(actions: list[Any]) -> list[tuple[str, ...]]:
    """What peers were told: ``(+ or -, topic)``."""
    found: list[tuple[str, ...]] = []
    for action in actions:
        if isinstance(action, Send) and isinstance(action.message, Advertise):
            found += [("-", source.topic) for source in action.message.removed]
            found += [("+", offer.topic) for offer in action.message.added]
    return found


def say(exports: Exports, *names: str, node: str = "/n") -> list[Any]:
    """Let one node publish these topics, and no others; what peers are told of it."""
    actions: list[Any] = []
    for topic in (*exports.topics, *names):
        actions += exports.graph(topic, {node: LocalSource(TYPE, "http://127.0.0.1:4000/")} if topic in names else {})
    while exports.pending:
        actions += exports.advertise()
    return actions


def learn(imports: Imports, *names: str, peer: int = 1, node: str = "/n") -> list[Any]:
    return imports.advertised(peer, Advertise(added=tuple(TopicOffer(name, node, TYPE) for name in names)))


def changed(imports: Imports, side: Side) -> list[Any]:
    return [a for actions in imports.apply_rules(side.policy, side.contracts, side.names, 0.0) for a in actions]


# --- outbound -------------------------------------------------------------------------------------------------------


def test_a_peer_gets_no_more_than_its_rules_allow() -> None:
    rules = PeerRule("guest", policy=PolicySettings(allow=("/{peer}/**", "/pose"), deny_types=("x/*",)))
    exports = Side(rules, policy=PolicySettings(deny=("/guest/private",))).exports()
    say(exports, "/guest/a", "/guest/private", "/pose", "/secret")
    assert offered(exports.link_up(1, "guest")) == [("+", "/guest/a"), ("+", "/pose")]
    assert offered(exports.link_up(2, "friend")) == [("+", "/guest/a"), ("+", "/pose"), ("+", "/secret")]
    [closed] = exports.opened(1, OpenRoute(1, "/secret", "/n"))
    assert closed == Send(1, RouteClosed(1, "/secret from /n: not published here, or policy keeps it home"))


def test_no_name_over_there_is_one_that_never_crosses() -> None:
    exports = Side(ROBOT).exports()
    say(exports, "/robot1/rosout", "/robot1/clock", "/robot1/rmpa/x", "/robot1/ok")
    assert offered(exports.link_up(1, "robot1")) == [("+", "/ok")]


def test_new_rules_end_and_begin_what_they_are_about_and_nothing_else() -> None:
    exports = Side().exports()
    exports.link_up(1, "robot1")
    exports.link_up(2, "base")
    say(exports, "/a", "/b", "/c")
    for peer in (1, 2):
        for route, topic in enumerate(("/a", "/b", "/c"), 1):
            exports.opened(peer, OpenRoute(route, topic, "/n"))
    for topic in ("/a", "/b", "/c"):
        exports.described(Source(topic, "/n"), ABOUT)
    rule = PeerRule("robot*", "", (), (("/b", "/bee"),), PolicySettings(deny=("/c",)))
    new = Side(rule)
    actions = exports.apply_rules(new.policy, new.contracts, new.names) + say(exports, "/a", "/b", "/c")
    assert [(a.peer, a.source.topic) for a in actions if isinstance(a, RemoveRoute)] == [(1, "/b"), (1, "/c")]
    assert [a.peer for a in actions if isinstance(a, Send)] == [1, 1, 1]
    assert sorted(offered(actions)) == [("+", "/bee"), ("-", "/b"), ("-", "/c")]
    assert not any(isinstance(action, Disconnect) for action in actions)
    assert exports.flowing(Source("/a", "/n")) == (1, 2)
    back = Side()
    actions = exports.apply_rules(back.policy, back.contracts, back.names) + say(exports, "/a", "/b", "/c")
    assert sorted(offered(actions)) == [("+", "/b"), ("+", "/c"), ("-", "/bee")]


# --- inbound --------------------------------------------------------------------------------------------------------


def test_robots_that_are_all_alike_have_each_its_namespace_here() -> None:
    imports = Side(ROBOT).imports()
    for peer, name in ((1, "robot1"), (2, "robot2"), (3, "base")):
        imports.link_up(peer, name)
    odom = Source("/odom", "/n")
    assert learn(imports, "/odom", peer=1) == [Publish(1, odom, TYPE, "/robot1/odom")]
    assert learn(imports, "/odom", peer=2) == [Publish(2, odom, TYPE, "/robot2/odom")]
    assert learn(imports, "/odom", peer=3) == [Publish(3, odom, TYPE)]
    assert imports.demand(2, odom, 0.0, wanted=True) == [Send(2, OpenRoute(1, "/odom", "/n"))]
    assert list(imports.offered_by(1)) == ["/robot1/odom"]


# --- both, in every order -------------------------------------------------------------------------------------------

TOPICS = ("/a", "/b", "/p/a")
NODES = ("/n", "/m")
SIDES = (
    (), (PeerRule("p", "/p"),), (PeerRule("p", "", (("/a", "/b"),), (("/b", "/a"),)),),
    (PeerRule("*", "/q", (("/p/**", "/**"),), (), PolicySettings(deny=("/b",))),),
)  # fmt: skip


class World:
    """An exporting and an importing bridge whose rules change, and the wires between them."""

    def __init__(self) -> None:
        self.rules: list[tuple[PeerRule, ...]] = [(), ()]
        self.exports, self.imports = Side().exports(), Side().imports()
        self.now = 0.0
        self.to_importer: deque[bytes] = deque()
        self.to_exporter: deque[bytes] = deque()
        self.connected: set[Source] = set()
        self.sending: set[tuple[Source, int]] = set()
        self.receiving: dict[int, Source] = {}
        self.here: dict[Source, tuple[str, str]] = {}
        self.local: set[Source] = set()
        self.starts = 0
        self.wanted: set[tuple[str, str]] = set()
        self.act(self.exports.link_up(1, "p"))
        self.act(self.imports.link_up(1, "p"))

    def act(self, actions: list[Any]) -> None:
        for action in actions:
            match action:
                case Send(_, Advertise() | RouteOpened() | RouteClosed() as message):
                    self.to_importer.append(encode(message))
                case Send(_, message):
                    self.to_exporter.append(encode(message))
                case Publish() | Retract() | Describe() | Detach():
                    self.act_here(action)
                case Connect(source):
                    assert source not in self.connected
                    self.connected.add(source)
                case Disconnect(source):
                    self.connected.discard(source)
                case AddRoute(source, _, route):
                    assert (source, route) not in self.sending
                    self.sending.add((source, route))
                case RemoveRoute(source, _, route):
                    self.sending.remove((source, route))
                case _:
                    assert isinstance(action, Warn)

    def act_here(self, action: Publish | Retract | Describe | Detach) -> None:
        match action:
            case Publish(_, source, _, topic):
                place = (topic or source.topic, source.node)
                assert place not in self.here.values()
                self.here[source] = place
                if place in self.wanted:
                    self.act(self.imports.demand(1, source, self.now, wanted=True))
            case Retract(_, source):
                assert source not in self.receiving.values()
                del self.here[source]
            case Describe(_, source, route):
                assert source in self.here
                self.receiving[route] = source
            case Detach(_, _, route):
                self.receiving.pop(route, None)

    def graph(self, topic: str) -> None:
        uri = f"http://127.0.0.1:{4000 + self.starts}/"
        at = {s.node: LocalSource(TYPE, uri) for s in self.local if s.topic == topic}
        self.act(self.exports.graph(topic, at))

    def change(self, side: int, rules: tuple[PeerRule, ...]) -> None:
        self.rules[side] = rules
        new = Side(*rules)
        if side == 0:
            self.act(self.exports.apply_rules(new.policy, new.contracts, new.names))
            for topic in TOPICS:
                self.graph(topic)
        else:
            for actions in self.imports.apply_rules(new.policy, new.contracts, new.names, self.now):
                self.act(actions)

    def deliver(self) -> bool:
        if self.to_importer:
            message = decode(self.to_importer.popleft())
            if isinstance(message, Advertise):
                self.act(self.imports.advertised(1, message))
            elif isinstance(message, RouteOpened):
                self.act(self.imports.opened(1, message, self.now))
            else:
                assert isinstance(message, RouteClosed)
                self.act(self.imports.closed(1, message, self.now))
        elif self.to_exporter:
            message = decode(self.to_exporter.popleft())
            if isinstance(message, OpenRoute):
                self.act(self.exports.opened(1, message))
            elif isinstance(message, CloseRoute):
                self.act(self.exports.closed(1, message))
        else:
            return False
        return True

    def settle(self) -> None:
        for _ in range(200):
            while self.deliver() or self.exports.pending:
                self.act(self.exports.advertise())
            for source in list(self.connected):
                self.act(self.exports.described(source, ABOUT))
            if not self.to_importer and not self.to_exporter:
                timer = self.imports.next_timer()
                if timer is None:
                    return
                self.now = timer
                self.act(self.imports.handle_timer(self.now))
        raise AssertionError("it never settles")

    def step(self, what: str, number: int) -> None:
        if what == "deliver":
            for _ in range(number):
                self.deliver()
        elif what == "tell":
            self.act(self.exports.advertise())
        elif what == "describe":
            for source in list(self.connected):
                self.act(self.exports.described(source, ABOUT))
        elif what == "lose" and self.connected:
            source = sorted(self.connected)[number % len(self.connected)]
            self.connected.discard(source)
            self.act(self.exports.lost(source, "lost"))
        elif what == "restart" and self.local:
            source = sorted(self.local)[number % len(self.local)]
            self.starts += 1
            self.graph(source.topic)
        elif what == "wait":
            self.now += number
            self.act(self.imports.handle_timer(self.now))
        elif what in {"far rules", "near rules"}:
            self.change(what == "near rules", SIDES[number % len(SIDES)])
        elif what == "publish":
            topic = TOPICS[number % len(TOPICS)]
            self.local ^= {Source(topic, NODES[number % 2])}
            self.graph(topic)
        elif what == "want":
            place = (("/a", "/b", "/p/a", "/p/b", "/q/a")[number % 5], NODES[number % 2])
            self.wanted ^= {place}
            for source in [source for source, at in self.here.items() if at == place]:
                self.act(self.imports.demand(1, source, self.now, wanted=place in self.wanted))

    def expected(self) -> set[tuple[str, str]]:
        """Where what is published stands at the importer."""
        far, near = (Side(*rules) for rules in self.rules)
        found = set()
        for source in self.local:
            wire = far.names.of("p").wire_name(source.topic)
            if far.policy.judge_for("p", source.topic, TYPE, wire).allowed:
                topic = near.names.of("p").local_name(wire)
                if near.policy.judge_for("p", topic, TYPE, wire).allowed:
                    found.add((topic, source.node))
        return found


_WHAT = ("publish", "want", "deliver") * 2 + (
    *("far rules", "near rules", "tell", "describe", "lose", "restart", "wait"),
)


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(_WHAT), st.integers(0, 11)), max_size=50))
def test_after_reloads_exactly_the_last_rules_hold(steps: list[tuple[str, int]]) -> None:
    world = World()
    for what, number in steps:
        world.step(what, number)
    world.settle()
    assert set(world.here.values()) == world.expected()
    flowing = {source for source, place in world.here.items() if place in world.wanted}
    assert set(world.receiving.values()) == flowing
    assert {route for _, route in world.sending} == set(world.receiving)
    assert {world.exports.local(1, wire) for wire in flowing} == {source for source, _ in world.sending}
    assert world.connected == {source for source, _ in world.sending}
    for source in world.here:
        entry = world.imports.entry(1, source)
        assert entry.state == ("open" if source in flowing else "idle")
