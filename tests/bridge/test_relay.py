"""Relays between networks: whole maps of modules, each with its exports and imports, in any order of events."""

from __future__ import annotations

import itertools
import random
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec
import pytest

from rmpa.bridge import limits
from rmpa.bridge.messages import Advertise, AdvertiseServices, Origin, Source, decode, encode
from rmpa.bridge.offers import PeerRun
from rmpa.bridge.peer_offers import Heard, RelayPaths
from rmpa.bridge.policy import OPEN_GATE, Names, PermissionGate, Policy, Relay
from rmpa.bridge.services.bodies import LocalService
from rmpa.bridge.topics.exports import LocalSource
from rmpa.config.peer_rules import PolicySettings
from rmpa.config.settings import ServiceSettings
from tests.bridge.recorder import (
    Exports,
    Imports,
    Moved,
    PathChanged,
    PeerServiceRules,
    Provide,
    Publish,
    Retract,
    Send,
    ServiceExports,
    ServiceImports,
    Warn,
    Withdraw,
)

TYPE = "std_msgs/String"


def instance(number: int) -> str:
    return f"{number:032x}"


def origin(number: int, *path: int) -> Origin:
    return Origin(f"m{number}", f"10.0.0.{number}:4000#0", instance(number), "/n", tuple(map(instance, path)))


@dataclass
class Module:
    """One module: what it publishes, its links, and what stands in its graph for others."""

    number: int
    relays: bool
    gate: PermissionGate = field(default_factory=PermissionGate)
    exports: Exports = field(init=False)
    imports: Imports = field(init=False)
    service_exports: ServiceExports = field(init=False)
    service_imports: ServiceImports = field(init=False)
    relay: Relay = field(init=False)
    links: dict[int, int] = field(default_factory=dict)
    """Peer number here by module."""
    numbers: int = 0
    shown: dict[tuple[int, Source], tuple[str, str]] = field(default_factory=dict)
    """What a driver would register: topic and proxy's name, by peer and source."""
    provided: dict[tuple[int, str], tuple[str, str]] = field(default_factory=dict)
    """The same of services, by peer and service."""
    dirty: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        policy = Policy(PolicySettings())
        self.exports = Exports(policy, gate=self.gate)
        self.imports = Imports(policy, rng=lambda: 0.5, gate=self.gate)
        self.relay = Relay(enabled=self.relays)
        rules = PeerServiceRules(ServiceSettings(), policy, Names())
        self.service_exports = ServiceExports(rules, gate=self.gate)
        self.service_imports = ServiceImports(rules, gate=self.gate)
        self.relay.instance = self.imports.ways.instance = instance(self.number)
        self.service_imports.ways.instance = instance(self.number)
        self.look()

    @property
    def topics(self) -> set[str]:
        """Two, for what goes may go one by one."""
        return {f"/t{self.number}", f"/u{self.number}"}

    @property
    def services(self) -> set[str]:
        return {f"/s{self.number}", f"/v{self.number}"}

    def direct(self, peer: int, node: str) -> Origin:
        """Whose a source is that comes by the link of its own module."""
        there = next(module for module, number in self.links.items() if number == peer)
        return Origin(f"m{there}", f"10.0.0.{there}:4000#0", instance(there), node, ())

    def look(self) -> list[Any]:
        """The local graph as the agent's driver reads it."""
        topics = {*self.topics, *self.dirty, *(place[0] for place in self.shown.values())}
        actions: list[Any] = []
        for service in {*self.services, *self.dirty, *(place[0] for place in self.provided.values())}:
            nodes = {place[1] for place in self.provided.values() if place[0] == service}
            assert len(nodes) <= 1, "a graph has one provider"
            local = LocalService("/n", "uri") if service in self.services else None
            for node in nodes:
                if whose := self.relay.origin((f"service {service}", node)):
                    local = LocalService(node, "uri", whose)
            actions += self.service_exports.graph(service, local)
        for topic in topics:
            nodes = {place[1] for place in self.shown.values() if place[0] == topic}
            graph = {n: LocalSource(TYPE, "uri", o) for n in nodes if (o := self.relay.origin((topic, n)))}
            if topic in self.topics:
                graph["/n"] = LocalSource(TYPE, "uri")
            actions += self.exports.graph(topic, graph)
        self.dirty = set()
        return actions

    def visible(self) -> list[tuple[str, str]]:
        return sorted(self.shown.values())

    def callable(self) -> list[tuple[str, str]]:
        return sorted(self.provided.values())


class Map:
    """Modules and the links between them; what is on its way on each, in order."""

    def __init__(
        self, count: int, relays: set[int], seed: int, gate: Callable[[int], PermissionGate] = lambda _: OPEN_GATE
    ) -> None:
        self.rng = random.Random(seed)
        self.modules = {n: Module(n, n in relays, gate(n)) for n in range(1, count + 1)}
        self.wires: dict[tuple[int, int], deque[bytes]] = {}

    def link(self, one: int, other: int) -> None:
        for here, there in ((one, other), (other, one)):
            self.wires[here, there] = deque()
        for here, there in ((one, other), (other, one)):
            module = self.modules[here]
            module.numbers += 1
            number = module.links[there] = module.numbers
            self.act(here, module.imports.link_up(number, f"m{there}", instance(there), there))
            self.act(here, module.exports.link_up(number, f"m{there}", instance(there)))
            self.act(here, module.service_imports.link_up(number, f"m{there}", instance(there), there))
            self.act(here, module.service_exports.link_up(number, f"m{there}", instance(there)))

    def unlink(self, one: int, other: int) -> None:
        for here, there in ((one, other), (other, one)):
            del self.wires[here, there]
            module = self.modules[here]
            number = module.links.pop(there)
            self.act(here, module.service_exports.link_down(number))
            self.act(here, module.service_imports.gone(number))
            self.act(here, module.exports.link_down(number))
            self.act(here, module.imports.link_down(number))
            module.relay.peer_gone(number)
            for key in [key for key in module.shown if key[0] == number]:  # it is retracted with its peer
                module.dirty.add(module.shown.pop(key)[0])
            self.act(here, [Warn("", "", "its topics are retracted")])

    def act(self, here: int, actions: Sequence[Any]) -> None:
        module = self.modules[here]
        for action in actions:
            match action:
                case Send(peer, message):
                    there = next((m for m, number in module.links.items() if number == peer), None)
                    if there is not None:
                        self.wires[here, there].append(encode(message))
                case Publish(peer, source, _, topic, whose):
                    whose = whose or module.direct(peer, source.node)
                    place = (topic or source.topic, f"/rmpa/{whose.name}{whose.node}")
                    module.relay.shown(peer, source, place, whose)
                    module.shown[peer, source] = place
                case Moved(old, left, new, source, whose):
                    place = module.shown[new, source] = module.shown.pop((old, left))
                    module.relay.shown(new, source, place, whose or module.direct(new, source.node))
                    module.relay.gone(old, left)
                    module.dirty.add(place[0])
                case PathChanged(peer, Source() as source, whose) if (peer, source) in module.shown:
                    module.relay.shown(peer, source, module.shown[peer, source], whose)
                case PathChanged(peer, str(service), whose) if (peer, service) in module.provided:
                    place = module.provided[peer, service]
                    node = next(
                        one.node for _, one in module.service_imports if (one.peer, one.wire) == (peer, service)
                    )
                    source = Source(f"service {service}", node)
                    module.relay.shown(peer, source, (f"service {service}", place[1]), whose)
                case Retract(peer, source):
                    module.relay.gone(peer, source)
                    module.dirty.add(module.shown.pop((peer, source))[0])
                case Provide(peer, service, node):
                    remote = module.service_imports.get(peer, service)
                    whose = (remote.origin if remote is not None else None) or module.direct(peer, node)
                    name = f"/rmpa/{whose.name}{whose.node}"
                    module.relay.shown(peer, Source(f"service {service}", node), (f"service {service}", name), whose)
                    module.provided[peer, service] = (service, name)
                case Withdraw(peer, service, node):
                    module.relay.gone(peer, Source(f"service {service}", node))
                    module.dirty.add(module.provided.pop((peer, service))[0])
        if actions:
            self.act(here, module.look())

    def settle(self) -> None:
        for _ in range(20_000):
            for here, module in self.modules.items():
                while module.exports.pending:
                    self.act(here, module.exports.advertise())
                while module.service_exports.pending:
                    self.act(here, module.service_exports.advertise())
            full = [wire for wire, waiting in self.wires.items() if waiting]
            if not full:
                return
            there, here = self.rng.choice(full)
            message = decode(self.wires[there, here].popleft())
            module = self.modules[here]
            if isinstance(message, AdvertiseServices):
                self.act(here, module.service_imports.advertised(module.links[there], message))
                continue
            assert isinstance(message, Advertise)
            self.act(here, module.imports.advertised(module.links[there], message))
        raise AssertionError("it never settles")

    def reachable(self, start: int) -> set[int]:
        """Who ought to be visible: linked, or behind relays that are, as far as the hop limit allows."""
        found, ring = {start}, [start]
        for hop in range(limits.RELAY_HOPS_MAX + 1):
            onward = [m for m in ring if hop == 0 or self.modules[m].relays]
            ring = [other for m in onward for other in self.modules[m].links if other not in found]
            found.update(ring)
        return found - {start}

    def check(self) -> None:
        for here, module in self.modules.items():
            there = self.reachable(here)
            assert module.visible() == sorted((f"/{k}{m}", f"/rmpa/m{m}/n") for m in there for k in "tu"), here
            assert module.callable() == sorted((f"/{k}{m}", f"/rmpa/m{m}/n") for m in there for k in "sv"), here
            origins = [entry.origin for entry in module.imports if entry.shown]
            for whose in (*origins, *(remote.origin for _, remote in module.service_imports if remote.shown)):
                if whose is not None:
                    way = [int(text, 16) for text in (whose.instance, *whose.path)] + [here]
                    steps = all(other in self.modules[one].links for one, other in itertools.pairwise(way))
                    assert steps, f"module {here} believes in the way {way}"


def test_a_long_row_ends_at_the_hop_limit() -> None:
    world = Map(limits.RELAY_HOPS_MAX + 3, set(range(1, 10)), 1)
    for number in range(1, limits.RELAY_HOPS_MAX + 3):
        world.link(number, number + 1)
    world.settle()
    world.check()
    assert ("/t1", "/rmpa/m1/n") not in world.modules[limits.RELAY_HOPS_MAX + 3].visible()


@pytest.mark.parametrize("seed", range(40))
def test_any_map_settles_with_each_source_once_everywhere(seed: int) -> None:
    rng = random.Random(seed)
    count = rng.randint(3, 6)
    world = Map(count, set(rng.sample(range(1, count + 1), rng.randint(0, count))), seed)
    pairs = [(one, other) for one in range(1, count + 1) for other in range(one + 1, count + 1)]
    linked: set[tuple[int, int]] = set()
    for _ in range(12):
        pair = rng.choice(pairs)
        (world.unlink if pair in linked else world.link)(*pair)
        linked ^= {pair}
        if rng.random() < 0.6:
            world.settle()
            world.check()
    world.settle()
    world.check()


def heard(name: str, number: int) -> Heard[Any, Any, Any]:
    """A peer with a link that has told all."""
    return Heard(session=PeerRun(peer=number, name=name, instance=instance(number), rank=number), ready=True)


def test_the_way_is_told_and_what_came_round_is_not_shown() -> None:
    relay = heard("r", 2)
    ways = RelayPaths({1: relay})
    ways.instance = instance(9)
    assert not ways.count(1, origin(9, 2), 1)
    assert ways.why_not(1, origin(9, 2)) == "it is ours, and came back by a relay"
    assert not ways.count(1, origin(1, 9, 2), 1)
    assert ways.why_not(1, origin(1, 9, 2)) == "we passed it on ourselves"
    assert ways.count(1, origin(1, 2), 1)
    assert not ways.why_not(1, origin(1, 2))
    assert ways.count(1, origin(1, 2), -1)
    assert list(ways) == []
    assert ways.lost == {"m1": "r"}, "for `rmpa why`, which names the relay"
    assert ways.count(1, origin(1, 2), 1)
    assert ways.lost == {}
    assert ways.gone(1, relay.session) == {instance(1), instance(2)}
    assert ways.lost == {"m1": "r"}


def test_a_peer_that_claims_the_run_of_a_relayed_module_does_not_hide_it() -> None:
    """Instances are no secret: each member hears them in beacons. In a secured mesh the name alone is proved."""
    peers = {1: heard("r", 2)}
    ways = RelayPaths(peers)
    ways.instance = instance(9)
    ways.count(1, origin(1, 2), 1)
    peers[2] = heard("thief", 1)
    assert not ways.why_not(1, origin(1, 2))
    assert list(ways) == [(origin(1, 2), "r")]
    peers[3] = heard("m1", 1)
    assert ways.why_not(1, origin(1, 2)) == "m1 has a link of its own"
    assert list(ways) == []


def test_a_peer_that_may_not_relay_does_not_rename_a_module() -> None:
    ways = RelayPaths({1: heard("r", 2), 2: heard("liar", 3)}, lambda name: name == "r")
    ways.instance = instance(9)
    renamed = msgspec.structs.replace(origin(1, 3), name="other")
    ways.count(2, renamed, 1)
    ways.count(1, origin(1, 2), 1)
    ways.count(2, renamed, 1)
    assert list(ways) == [(origin(1, 2), "r")]
