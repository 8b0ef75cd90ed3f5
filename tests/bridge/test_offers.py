from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.bridge import limits
from rmpa.bridge.messages import Advertise, AdvertiseServices, ServiceOffer, Source, TopicOffer
from rmpa.bridge.policy import Names, Policy
from rmpa.bridge.services.bodies import LocalService
from rmpa.bridge.topics.exports import LocalSource
from rmpa.config.peer_rules import PeerRule, PolicySettings
from rmpa.config.settings import LimitSettings, ServiceSettings
from rmpa.core.contract import Contracts
from tests.bridge.recorder import (
    Exports,
    Imports,
    Provide,
    Publish,
    Retract,
    Send,
    ServiceExports,
    ServiceImports,
)
from tests.bridge.services.test_rules import rules

# What peers are told of an offer book: portions, names, limits, and when.


ONE = LocalService("/n", "rosrpc://127.0.0.1:1")


def book(limit: int = 1000, *peers: PeerRule) -> ServiceExports:
    return ServiceExports(rules(ServiceSettings(), peers), LimitSettings(services=limit))


def told(made: ServiceExports, *busy: int, now: float = 0.0) -> dict[int, tuple[list[str], list[str]]]:
    """What each peer is told next: what comes, and what goes."""
    found = {}
    for done in made.advertise(now, lambda peer: peer in busy):
        if isinstance(done, Send) and isinstance(done.message, AdvertiseServices):
            found[done.peer] = ([offer.service for offer in done.message.added], list(done.message.removed))
    return found


def test_beyond_the_limit_the_first_one_takes_the_next_free_place() -> None:
    made = book(limit=1)
    made.put("/a", ONE)
    (warning,) = made.put("/b", ONE)
    assert "limits.services = 1" in warning.text
    made.put("/c", ONE)
    assert list(made.beyond) == ["/b", "/c"]
    made.put("/c", None)
    made.put("/a", None)
    assert dict(made.offered) == {"/b": ONE}
    assert not made.beyond


def test_whole_accounts_are_told_to_one_peer_at_a_time_and_in_turn() -> None:
    made = book()
    for peer in (1, 2):
        made.link_up(peer, "far")
    for number in range(limits.ADVERTISED_AT_ONCE + 2):
        made.put(f"/e{number:03}", ONE)
    assert [list(told(made)) for _ in range(4)] == [[1], [2], [1, 2], []]


def test_a_portion_waits_while_the_lane_is_busy_but_not_for_ever() -> None:
    made = book()
    made.link_up(1, "far")
    made.link_up(2, "near")
    made.put("/a", ONE)
    assert list(told(made, 1, now=10.0)) == [1, 2], "the first one of a link does not wait"
    made.put("/b", ONE)
    assert list(told(made, 1, now=10.01)) == [2], "a peer that waits holds up no other"
    assert made.pending
    assert list(told(made, 1, now=10.0 + 1.01 * limits.TELL_PATIENCE)) == [1], "a lane that is never free gets on too"
    made.put("/c", ONE)
    assert set(told(made, now=10.2)) == {1, 2}, "it is free again"


@pytest.mark.parametrize("topic", ["/a", "/secret"])
def test_the_rule_that_decides_is_told_to_whom_asks(topic: str) -> None:
    guest = PeerRule("guest", policy=PolicySettings(deny=("/a",)))
    made = Exports(Policy(PolicySettings(deny=("/secret",)), (guest,)))
    made.graph(topic, {"/n": LocalSource("a/B", "http://x:1/")})
    made.link_up(1, "guest")
    made.link_up(2, "friend")
    source = Source(topic, "/n")
    decisions = [made.decision(peer, source) for peer in (1, 2)]
    assert [one.allowed for one in decisions] == ([False, True] if topic == "/a" else [False, False])
    assert decisions[0].rule == ("peer \"guest\".deny has '/a'" if topic == "/a" else "bridge.deny has '/secret'")
    assert made.decision(1, Source("/nothing", "/n")) is None
    assert [bool(made.offer(peer, source)) for peer in (1, 2)] == [one.allowed for one in decisions], "one judgement"


# How advertisements of one peer are split, and what is taken of them.


def test_a_bounded_number_of_refused_offers_is_remembered(monkeypatch: Any) -> None:
    monkeypatch.setattr(limits, "REFUSED_MAX", 1)
    made = ServiceImports(rules(), LimitSettings(services=1))
    made.link_up(1, "far")
    made.advertised(1, AdvertiseServices(tuple(ServiceOffer(name, "/n") for name in ("/a", "/b", "/c", "/b"))))
    assert made.refused(1) == 1


# What of a peer is beyond ``[limits]``: hidden, counted, and shown as soon as there is room.


def offers(nodes: range, topics: int = 1) -> tuple[TopicOffer, ...]:
    return tuple(TopicOffer(f"/n{n}/t{t}", f"/n{n}", "a/B") for n in nodes for t in range(topics))


def imports(*, nodes: int = 100, topics: int = 100) -> Imports:
    made = Imports(
        Policy(PolicySettings(deny=("/secret",))), lambda: 1.0, limit_settings=LimitSettings(nodes, topics)
    )
    made.link_up(1, "far")
    return made


def shown(made: Imports) -> set[str]:
    return {entry.node for entry in made if entry.shown}


def published(actions: list[Any]) -> list[str]:
    return [action.source.topic for action in actions if isinstance(action, Publish)]


def test_a_leaving_node_gives_its_place_to_the_longest_waiting() -> None:
    made = imports(nodes=2)
    made.advertised(1, Advertise(added=offers(range(4), topics=2)))
    assert published(made.advertised(1, Advertise(removed=(Source("/n0/t0", "/n0"),)))) == []
    actions = made.advertised(1, Advertise(removed=(Source("/n0/t1", "/n0"),)))
    assert [type(action) for action in actions] == [Retract, Publish, Publish]
    assert published(actions) == ["/n2/t0", "/n2/t1"]
    assert set(made.refused_nodes(1)) == {"/n3"}
    made.advertised(1, Advertise(removed=tuple(offer.source for offer in offers(range(3, 4), topics=2))))
    assert not made.refused_nodes(1), "one that is gone waits no more"


@pytest.mark.parametrize("kind", ["nodes", "topics"])
def test_a_limit_that_is_raised_holds_at_once_and_a_lower_one_for_what_comes(kind: str) -> None:
    def reload(value: int) -> list[Any]:
        most = LimitSettings(**{kind: value})
        policy = Policy(PolicySettings(deny=("/secret",)))
        return [a for some in made.apply_rules(policy, Contracts(), Names(), 0.0, most) for a in some]

    made = imports(**{kind: 2})
    made.advertised(1, Advertise(added=offers(range(5))))
    assert published(reload(4)) == ["/n2/t0", "/n3/t0"]
    assert published(reload(5)) == ["/n4/t0"]
    assert not made.refused_nodes(1)
    assert made.refused(1) == 0
    assert reload(1) == []
    assert shown(made) == {f"/n{number}" for number in range(5)}
    assert (
        published(made.advertised(1, Advertise(added=offers(range(5, 6)), removed=(Source("/n0/t0", "/n0"),)))) == []
    )
    assert published(reload(5)) == ["/n5/t0"]


_events = st.lists(st.tuples(st.booleans(), st.integers(0, 6), st.integers(0, 2)), max_size=60)


@given(_events, st.integers(1, 4), st.integers(1, 12))
def test_the_limits_hold_and_no_place_stays_empty(
    events: list[tuple[bool, int, int]], nodes: int, topics: int
) -> None:
    made = imports(nodes=nodes, topics=topics)
    there: set[Source] = set()
    for comes, node, topic in events:
        offer = TopicOffer(f"/n{node}/t{topic}", f"/n{node}", "a/B")
        if comes:
            there.add(offer.source)
            made.advertised(1, Advertise(added=(offer,)))
        else:
            there.discard(offer.source)
            made.advertised(1, Advertise(removed=(offer.source,)))
        known = {entry.wire: entry for entry in made}
        assert len(known) == min(topics, len(there))
        assert made.refused(1) == len(there) - len(known)
        standing = {source.node for source, entry in known.items() if entry.shown}
        assert len(standing) == min(nodes, len({source.node for source in known}))
        assert all(entry.shown is (source.node in standing) for source, entry in known.items())
        waiting = {source for sources in made.refused_nodes(1).values() for source in sources}
        assert waiting == {source for source, entry in known.items() if not entry.shown}


def reload_nodes(made: Imports, nodes: int, *denied: str) -> Iterator[list[Any]]:
    """One reload: another limit of nodes, and all topics of some nodes denied."""
    policy = Policy(PolicySettings(deny=tuple(f"{node}/*" for node in denied)))
    return made.apply_rules(policy, Contracts(), Names(), 0.0, LimitSettings(nodes=nodes))


_comes_or_goes = st.tuples(st.booleans(), st.integers(0, 6), st.integers(0, 2))


_reloads = st.tuples(st.integers(1, 6), st.sets(st.integers(0, 6)))


_steps = st.lists(_comes_or_goes | _reloads | st.integers(1, 9), max_size=40)


_Step = tuple[bool, int, int] | tuple[int, set[int]] | int


@pytest.mark.timeout(60)
@given(st.lists(st.sampled_from(offers(range(7), 3)), unique=True), _steps)
def test_after_reloads_no_place_is_empty_and_the_rest_is_counted(first: list[TopicOffer], steps: list[_Step]) -> None:
    made = imports(nodes=6)
    made.advertised(1, Advertise(added=tuple(first)))
    limit, denied = 6, set[int]()
    under_way: Iterator[list[Any]] = iter(())
    for step in steps:
        if isinstance(step, int):
            list(islice(under_way, step))
        elif len(step) == 2:
            limit, denied = step
            under_way = reload_nodes(made, limit, *(f"/n{node}" for node in denied))
        else:
            comes, node, topic = step
            offer = TopicOffer(f"/n{node}/t{topic}", f"/n{node}", "a/B")
            message = Advertise(added=(offer,)) if comes else Advertise(removed=(offer.source,))
            made.advertised(1, message)
    assert len(list(islice(under_way, 100))) < 100
    allowed = {entry.wire for entry in made if entry.node not in {f"/n{node}" for node in denied}}
    visible = {entry.wire for entry in made if entry.shown}
    standing = shown(made)
    assert len(standing) >= min(limit, len({source.node for source in allowed}))
    assert visible == {source for source in allowed if source.node in standing}
    assert {source for sources in made.refused_nodes(1).values() for source in sources} == allowed - visible


# --- services -----------------------------------------------------------------------------------------------------


def provided(*names: str, node: str = "/n", removed: tuple[str, ...] = ()) -> AdvertiseServices:
    return AdvertiseServices(tuple(ServiceOffer(name, node) for name in names), removed)


def services(*, nodes: int = 100, count: int = 100) -> ServiceImports:
    made = ServiceImports(rules(), LimitSettings(nodes=nodes, services=count))
    made.link_up(1, "far", rank=10)
    return made


def test_the_services_limits_are_reloaded() -> None:
    made = services(nodes=1, count=2)
    made.advertised(1, provided("/a", node="/first"))
    made.advertised(1, provided("/b", "/c", node="/second"))
    changed = [a for some in made.apply_rules(rules(), LimitSettings(nodes=2, services=3)) for a in some]
    assert changed == [Provide(1, "/b", "/second"), Provide(1, "/c", "/second")]


def reload_services(made: ServiceImports, nodes: int, *denied: str) -> Iterator[list[Any]]:
    settings = ServiceSettings(deny=tuple(f"{node}/*" for node in denied))
    return made.apply_rules(rules(settings), LimitSettings(nodes=nodes))


_services_come_or_go = st.tuples(st.booleans(), st.integers(0, 5), st.integers(0, 1), st.integers(1, 2))


@pytest.mark.timeout(60)
@given(st.lists(_services_come_or_go | _reloads | st.integers(1, 9), max_size=40))
def test_after_reloads_each_service_has_one_provider(
    steps: list[tuple[bool, int, int, int] | tuple[int, set[int]] | int],
) -> None:
    made = services(nodes=3)
    made.link_up(2, "other", rank=20)
    limit, denied = 3, set[int]()
    under_way: Iterator[list[Any]] = iter(())
    for step in steps:
        if isinstance(step, int):
            list(islice(under_way, step))
        elif len(step) == 2:
            limit, denied = step
            under_way = reload_services(made, limit, *(f"/n{node}" for node in denied))
        else:
            comes, node, service, peer = step
            name = f"/n{node}/s{service}"
            made.advertised(peer, provided(name, node=f"/n{node}") if comes else provided(removed=(name,)))
    assert len(list(islice(under_way, 200))) < 200
    visible = [remote.name for _, remote in made if remote.shown]
    assert len(visible) == len(set(visible))
    for peer in (1, 2):
        standing = {remote.node for number, remote in made if number == peer and remote.shown}
        assert len(standing) >= limit or not made.refused_nodes(peer)
        assert not standing & set(made.refused_nodes(peer))
    for peer, remote in made:
        waits = remote.name in made.refused_nodes(peer).get(remote.node, ())
        if remote.node in {f"/n{node}" for node in denied}:
            assert not remote.shown
            assert not waits
        elif not remote.shown:
            assert waits or remote.name in visible
