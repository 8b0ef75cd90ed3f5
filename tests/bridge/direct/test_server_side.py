"""The server's side of direct calls: which changes the peers are told of."""

from __future__ import annotations

import pytest

from rmpa.bridge import limits
from rmpa.bridge.direct.conditions import Condition, Grant, Unmet
from rmpa.bridge.direct.server_side import CloseDirect, RetryDirect, ServiceGrants

URI = "rosrpc://10.0.0.1:45000"
GRANT = Grant(45000, "/adder")
REFUSED = Unmet(Condition.LISTENING, "/adder listens on loopback only")
FORBIDDEN = Unmet(Condition.TRANSPORT, "relay")


@pytest.fixture
def grants() -> ServiceGrants:
    """Peer 1 was granted the service, and peer 2 was refused."""
    made = ServiceGrants()
    made.answered(1, "/add", "/adder", URI, GRANT)
    made.answered(2, "/add", "/adder", URI, REFUSED)
    return made


def test_a_server_at_another_port_makes_every_peer_ask_again(grants: ServiceGrants) -> None:
    assert grants.server("/add", "/adder", URI) == []
    assert grants.server("/add", "/adder", "rosrpc://10.0.0.1:45001") == [
        CloseDirect(1, "/add", "/adder", Unmet(Condition.NODE, "/adder has restarted")),
        RetryDirect(2, "/add", "/adder"),
    ]
    assert list(grants) == []


@pytest.mark.parametrize("node", ["", "/other"])
def test_what_the_advertisement_tells_needs_no_notification(grants: ServiceGrants, node: str) -> None:
    assert grants.server("/add", node, URI if node else "") == []
    assert list(grants) == []


def test_other_rules_withdraw_and_offer_again(grants: ServiceGrants) -> None:
    assert grants.judge_again(lambda _service, _peer: FORBIDDEN) == [CloseDirect(1, "/add", "/adder", FORBIDDEN)]
    assert grants.peers("/add") == ()
    assert grants.judge_again(lambda _service, _peer: FORBIDDEN) == []
    assert grants.judge_again(lambda _service, _peer: None) == [
        RetryDirect(1, "/add", "/adder"),
        RetryDirect(2, "/add", "/adder"),
    ]
    assert grants.judge_again(lambda _service, _peer: None) == []


def test_a_peer_without_a_link_is_told_nothing(grants: ServiceGrants) -> None:
    assert (grants.ports(1), grants.ports(2)) == ({45000}, set())
    grants.peer_gone(1)
    assert grants.ports(1) == set()
    assert grants.server("/add", "/adder", "rosrpc://10.0.0.1:1") == [RetryDirect(2, "/add", "/adder")]


def test_the_grants_of_one_peer_are_bounded(grants: ServiceGrants) -> None:
    for number in range(limits.DIRECT_MAX - 1):
        assert grants.full(1, f"/s{number}") is None
        grants.answered(1, f"/s{number}", "/n", URI, GRANT)
    beyond = grants.full(1, "/one_more")
    assert beyond is not None
    assert beyond.condition is Condition.LIMIT
    assert grants.full(1, "/s0") is None
    assert grants.full(2, "/one_more") is None
    grants.released(1, "/s0", "/another")
    assert grants.full(1, "/one_more") is not None
    grants.released(1, "/s0", "/n")
    assert grants.full(1, "/one_more") is None
