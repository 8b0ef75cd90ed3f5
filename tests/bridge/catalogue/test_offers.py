"""What peers are told of an offer book: portions, names, limits, and when."""

from __future__ import annotations

import pytest

from rmpa.bridge import limits
from rmpa.bridge.messages import AdvertiseServices, ServiceOffer
from rmpa.bridge.policy import Policy
from rmpa.bridge.services.bodies import LocalService
from rmpa.config.peer_rules import PeerRule, PolicySettings
from rmpa.config.settings import LimitSettings, ServiceSettings
from tests.bridge.recorder import Exports, Send, ServiceExports, Warn
from tests.bridge.services.test_rules import rules

ONE, TWO = LocalService("/n", "rosrpc://127.0.0.1:1"), LocalService("/n", "rosrpc://127.0.0.1:2")


def book(limit: int = 1000, *peers: PeerRule) -> ServiceExports:
    return ServiceExports(rules(ServiceSettings(), peers), LimitSettings(services=limit))


def told(made: ServiceExports, *busy: int, now: float = 0.0) -> dict[int, tuple[list[str], list[str]]]:
    """What each peer is told next: what comes, and what goes."""
    found = {}
    for done in made.advertise(now, lambda peer: peer in busy):
        if isinstance(done, Send) and isinstance(done.message, AdvertiseServices):
            found[done.peer] = ([offer.service for offer in done.message.added], list(done.message.removed))
    return found


def test_a_new_peer_is_told_everything_in_portions() -> None:
    made = book()
    for number in range(limits.ADVERTISED_AT_ONCE + 2):
        made.put(f"/e{number:03}", ONE)
    (first,) = made.link_up(1, "far")
    begin = first.message
    assert (len(begin.added), begin.full, begin.more) == (limits.ADVERTISED_AT_ONCE, True, True)
    assert made.pending
    ((_, rest),) = made.advertise()
    assert (len(rest.added), rest.full, rest.more, made.pending) == (2, False, False, False)


def test_of_two_entries_of_one_name_the_second_waits_for_the_first() -> None:
    made = book(1000, PeerRule("robot", prefix="/r"))
    made.put("/go", ONE)
    made.put("/r/go", TWO)
    warning, message = made.link_up(1, "robot")
    assert warning == Warn("names.taken", "1 /r/go", "/r/go would be /go at robot, as /go is already: rename one")
    assert message.message.added == (ServiceOffer("/go", "/n"),)
    made.put("/go", None)
    # What waits is told behind it.
    assert told(made) == {1: ([], ["/go"])}
    assert told(made) == {1: (["/go"], [])}
    assert made.offer(1, "/r/go") == ServiceOffer("/go", "/n")


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


def test_a_peer_without_a_link_is_told_nothing() -> None:
    made = book()
    made.link_up(1, "far")
    made.link_down(1)
    made.put("/a", ONE)
    assert told(made) == {}
    assert made.offer(1, "/a") is None


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
    from rmpa.bridge.messages import Source
    from rmpa.bridge.topics.exports import LocalSource

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
