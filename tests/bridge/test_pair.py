"""Both halves of two bridges back to back, in every order that hypothesis finds."""

from __future__ import annotations

from collections import deque
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from rmpa.bridge.messages import (
    Advertise,
    CloseRoute,
    Description,
    Message,
    Mismatch,
    OpenRoute,
    RouteClosed,
    RouteOpened,
    Source,
    decode,
    encode,
)
from rmpa.bridge.policy import Policy
from rmpa.bridge.topics.exports import LocalSource
from rmpa.config.peer_rules import PolicySettings
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
)

SOURCES = [Source("/a", "/n"), Source("/a", "/m"), Source("/b", "/n")]
TOPIC_ABOUT = Description("a/B", "5a9ea5f83505693b71e785041e67a8bb", "", False)


class World:
    """An exporting and an importing bridge, the wires between them, and what their drivers have in hand."""

    def __init__(self) -> None:
        policy = Policy(PolicySettings())
        self.exports = Exports(policy)
        self.imports = Imports(policy, rng=lambda: 0.5)
        self.now = 0.0
        self.to_importer: deque[bytes] = deque()
        self.to_exporter: deque[bytes] = deque()
        self.connected: set[Source] = set()
        self.sending: set[tuple[Source, int]] = set()
        self.visible: set[Source] = set()
        self.receiving: dict[int, Source] = {}
        self.local: dict[Source, LocalSource] = {}
        self.wanted: set[Source] = set()
        self.act(self.exports.link_up(1))
        self.act(self.imports.link_up(1))

    def act(self, actions: list[Any]) -> None:
        for action in actions:
            match action:
                case Send(_, Advertise() | RouteOpened() | RouteClosed() as message):
                    self.to_importer.append(encode(message))
                case Send(_, message):
                    self.to_exporter.append(encode(message))
                case Connect(source):
                    assert source not in self.connected
                    self.connected.add(source)
                case Disconnect(source):
                    self.connected.discard(source)
                case AddRoute(source, _, route):
                    assert source in self.connected
                    assert (source, route) not in self.sending
                    self.sending.add((source, route))
                case RemoveRoute(source, _, route):
                    self.sending.remove((source, route))
                case Publish(_, source):
                    assert source not in self.visible
                    self.visible.add(source)
                case Retract(_, source):
                    self.visible.remove(source)
                    assert source not in self.receiving.values()
                case Describe(_, source, route):
                    assert source in self.visible
                    self.receiving[route] = source
                case Detach(_, _, route):
                    self.receiving.pop(route, None)
                case _:
                    raise AssertionError(action)

    def graph_changed(self, topic: str) -> None:
        publishers = {source.node: local for source, local in self.local.items() if source.topic == topic}
        self.act(self.exports.graph(topic, publishers))

    def deliver(self) -> bool:
        if self.to_importer:
            self._import(decode(self.to_importer.popleft()))
        elif self.to_exporter:
            self._export(decode(self.to_exporter.popleft()))
        else:
            return False
        return True

    def _import(self, message: Message) -> None:
        match message:
            case Advertise():
                self.act(self.imports.advertised(1, message))
                for source in self.wanted & self.visible:
                    self.act(self.imports.demand(1, source, self.now, wanted=True))
            case RouteOpened():
                self.act(self.imports.opened(1, message, self.now))
            case RouteClosed():
                self.act(self.imports.closed(1, message, self.now))
            case _:
                raise AssertionError(message)

    def _export(self, message: Message) -> None:
        match message:
            case OpenRoute():
                self.act(self.exports.opened(1, message))
            case CloseRoute():
                self.act(self.exports.closed(1, message))
            case Mismatch():
                pass
            case _:
                raise AssertionError(message)

    def settle(self) -> None:
        for _ in range(200):
            while self.deliver() or self.exports.pending:
                self.act(self.exports.advertise())
            for source in list(self.connected):
                self.act(self.exports.described(source, TOPIC_ABOUT))
            timer = self.imports.next_timer()
            if not self.to_importer and not self.to_exporter:
                if timer is None:
                    return
                self.now = timer
                self.act(self.imports.handle_timer(self.now))
        raise AssertionError("it never settles")


_steps = st.lists(
    st.one_of(
        st.tuples(st.just("publish"), st.integers(0, 2)),
        st.tuples(st.just("unpublish"), st.integers(0, 2)),
        st.tuples(st.just("restart"), st.integers(0, 2)),
        st.tuples(st.just("want"), st.integers(0, 2)),
        st.tuples(st.just("unwant"), st.integers(0, 2)),
        st.tuples(st.just("describe"), st.integers(0, 2)),
        st.tuples(st.just("lose"), st.integers(0, 2)),
        st.tuples(st.just("tell"), st.just(0)),
        st.tuples(st.just("deliver"), st.integers(1, 3)),
        st.tuples(st.just("wait"), st.integers(1, 9)),
    ),
    max_size=60,
)


def _step(world: World, what: str, index: int) -> None:
    if what == "deliver":
        for _ in range(index):
            world.deliver()
        return
    if what == "wait":
        world.now += index
        world.act(world.imports.handle_timer(world.now))
        return
    source = SOURCES[index]
    if what in {"publish", "restart"}:
        if (what == "publish") != (source in world.local):
            world.local[source] = LocalSource("a/B", f"http://127.0.0.1:{4000 + len(world.local) + int(world.now)}/")
            world.graph_changed(source.topic)
    elif what == "unpublish":
        world.local.pop(source, None)
        world.graph_changed(source.topic)
    elif what == "tell":
        world.act(world.exports.advertise())
    elif what == "describe" and source in world.connected:
        world.act(world.exports.described(source, TOPIC_ABOUT))
    elif what == "lose" and source in world.connected:
        world.connected.discard(source)
        world.act(world.exports.lost(source, "lost"))
    elif what in {"want", "unwant"}:
        (world.wanted.add if what == "want" else world.wanted.discard)(source)
        if source in world.visible:
            world.act(world.imports.demand(1, source, world.now, wanted=what == "want"))


@settings(max_examples=400, deadline=None)
@given(_steps)
def test_after_it_settles_exactly_what_is_published_and_wanted_flows(steps: list[tuple[str, int]]) -> None:
    world = World()
    for what, index in steps:
        _step(world, what, index)
    world.settle()
    published = set(world.local)
    assert world.visible == published
    flowing = published & world.wanted
    assert world.connected == flowing
    assert {source for source, _ in world.sending} == flowing
    assert len(world.sending) == len(flowing)
    assert {(source, route) for route, source in world.receiving.items()} == world.sending
    for source in published:
        entry = world.imports.get(1, source)
        assert entry is not None
        assert entry.state == ("open" if source in flowing else "idle")


topics = st.sampled_from(["/a", "/b", "/c"])
nodes = st.sampled_from(["/n", "/m"])
