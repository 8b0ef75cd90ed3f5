"""Which of the peers' services are shown, and how one is opened."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.bridge import limits
from rmpa.bridge.messages import (
    AdvertiseServices,
    CloseService,
    OpenService,
    ServiceClosed,
    ServiceOffer,
    ServiceOpened,
)
from rmpa.config.peer_rules import PeerRule
from rmpa.core.errors import LocalProtocolError, RemoteProtocolError
from rmpa.ros.wire.tcpros import ServiceDescription
from tests.bridge.recorder import EndedService, ForgetAbout, OpenedService, Provide, Send, ServiceImports, Withdraw
from tests.bridge.services.test_rules import apply_rules, rules

if TYPE_CHECKING:
    pass

MD5 = "6a2e34150c00229791cc89ff309fff21"
ROUTE = limits.SERVICE_ROUTES + 1
REQUESTS = limits.SERVICE_ROUTES + 2


def offer(*services: str, node: str = "/n", full: bool = False, more: bool = False) -> AdvertiseServices:
    return AdvertiseServices(tuple(ServiceOffer(service, node) for service in services), (), full, more)


@pytest.fixture
def imports() -> ServiceImports:
    """One peer with one service."""
    made = ServiceImports(rules())
    made.link_up(1, "base", rank=10)
    assert made.advertised(1, offer("/add", full=True)) == [Provide(1, "/add", "/n")]
    return made


def opened(imports: ServiceImports) -> None:
    assert imports.want(imports.get(1, "/add"), 0.0) == [Send(1, OpenService(ROUTE, "/add"))]
    assert imports.opened(1, ServiceOpened(ROUTE, REQUESTS, "a/Add", MD5)) == [
        OpenedService(1, "/add", ROUTE, REQUESTS, ServiceDescription("a/Add", MD5))
    ]


def about(imports: ServiceImports) -> ServiceDescription | None:
    remote = imports.entry(1, "/add")
    found: ServiceDescription | None = remote.about
    return found


def hidden(imports: ServiceImports, peer: int, service: str = "/add") -> str:
    remote = imports.entry(peer, service)
    return imports.hidden(remote)


def test_a_local_service_always_comes_first(imports: ServiceImports) -> None:
    opened(imports)
    reason = "/mine of this module provides it itself"
    assert imports.local("/add", "/mine") == [
        Send(1, CloseService(ROUTE)), EndedService(1, "/add", ROUTE, reason), Withdraw(1, "/add", "/n", reason),
    ]  # fmt: skip
    assert hidden(imports, 1) == reason
    assert imports.local("/add", None) == [Provide(1, "/add", "/n")]
    assert imports.local("/other", "/mine") == []
    assert imports.advertised(1, offer("/other")) == []
    assert "provides it itself" in hidden(imports, 1, "/other")


def test_of_several_peers_the_lowest_guid_is_shown(imports: ServiceImports) -> None:
    imports.link_up(2, "arm", rank=5)
    text = "arm provides it too, and is shown: its GUID is lower"
    assert imports.advertised(2, offer("/add", full=True)) == [
        Withdraw(1, "/add", "/n", text),
        Provide(2, "/add", "/n"),
    ]
    imports.link_up(3, "leg", rank=7)
    assert imports.advertised(3, offer("/add", full=True)) == []
    assert (hidden(imports, 1), hidden(imports, 3)) == (text, text)
    assert imports.gone(2) == [Withdraw(2, "/add", "/n", "arm is gone"), Provide(3, "/add", "/n")]
    assert imports.advertised(3, AdvertiseServices(removed=("/add",)))[-1] == Provide(1, "/add", "/n")


def test_an_opened_service_is_known_until_its_server_is_another_one(imports: ServiceImports) -> None:
    opened(imports)
    assert imports.want(imports.get(1, "/add"), 1.0) == [], "it is open"
    closing = imports.release(imports.get(1, "/add"), "no node calls it")
    assert closing[0] == Send(1, CloseService(ROUTE))
    assert about(imports) == ServiceDescription("a/Add", MD5)
    assert imports.advertised(1, offer("/add")) == [ForgetAbout(1, "/add")]
    assert about(imports) is None
    remote = imports.get(1, "/add")
    assert imports.want(remote, 2.0) == [Send(1, OpenService(ROUTE + 2, "/add"))], "a route is never used again"


def test_a_peer_that_does_not_answer_is_given_up(imports: ServiceImports) -> None:
    imports.want(imports.get(1, "/add"), 3.0)
    due = imports.next_timer()
    assert due == 3.0 + 60.0, "the time for a call"
    assert imports.handle_timer(due - 0.1) == []
    text = "the agent of base does not answer"
    assert imports.handle_timer(due) == [Send(1, CloseService(ROUTE)), EndedService(1, "/add", ROUTE, text)]
    assert imports.next_timer() is None
    assert imports.opened(1, ServiceOpened(ROUTE, REQUESTS, "a/Add", MD5)) == [], "too late"


def test_a_lost_link_ends_calls_and_keeps_services_until_the_peer_is_gone(imports: ServiceImports) -> None:
    opened(imports)
    assert imports.link_down(1) == [EndedService(1, "/add", ROUTE, "the link to base was lost")]
    assert hidden(imports, 1) == ""
    with pytest.raises(LocalProtocolError):
        imports.want(imports.get(1, "/add"), 1.0)
    assert imports.link_up(1, "base", rank=10) == []
    assert imports.advertised(1, offer("/add", full=True)) == [ForgetAbout(1, "/add")]
    opened(imports)  # routes are counted by link
    assert imports.gone(1)[-1] == Withdraw(1, "/add", "/n", "base is gone")
    assert imports.gone(1) == []
    assert list(imports) == []


def test_opened_twice_breaks_the_protocol(imports: ServiceImports) -> None:
    opened(imports)
    with pytest.raises(RemoteProtocolError):
        imports.opened(1, ServiceOpened(ROUTE, REQUESTS, "a/Add", MD5))


def test_names_here_are_made_by_the_peers_rules() -> None:
    made = ServiceImports(rules(peers=(PeerRule("robot", prefix="/robot1"),)))
    made.link_up(1, "robot", rank=1)
    assert made.advertised(1, offer("/go", full=True)) == [Provide(1, "/robot1/go", "/n")]
    assert made.want(made.get(1, "/robot1/go"), 0.0) == [Send(1, OpenService(ROUTE, "/go"))]
    made.closed(1, ServiceClosed(ROUTE, "no"))
    changed = apply_rules(made, rules(peers=(PeerRule("robot", prefix="/r"),)))
    assert [type(action) for action in changed] == [Withdraw, Provide]
    assert made.get(1, "/r/go") is not None
    assert made.get(1, "/robot1/go") is None


def test_two_of_one_peer_that_would_have_one_name_here() -> None:

    made = ServiceImports(rules(peers=(PeerRule("robot", remap_in=(("/a", "/b"),)),)))
    made.link_up(1, "robot", rank=1)
    assert made.advertised(1, offer("/a", "/b", full=True)) == [Provide(1, "/b", "/n")]
    second = [remote for _, remote in made if not remote.shown]
    assert "has this name here already" in made.hidden(second[0])
