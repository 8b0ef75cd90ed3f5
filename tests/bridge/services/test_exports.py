"""What peers are told of our services, and what they may open."""

from __future__ import annotations

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
from rmpa.bridge.services.bodies import LocalService
from rmpa.config import limits as config_limits
from rmpa.ros.wire.tcpros import ServiceDescription
from tests.bridge.recorder import EndRoute, Probe, Send, ServerGone, ServeRoute, ServiceExports
from tests.bridge.services.test_rules import rules

ADD = LocalService("/adder", "rosrpc://127.0.0.1:5")
ABOUT = ServiceDescription("a/Add", "6a2e34150c00229791cc89ff309fff21")
ROUTE = limits.SERVICE_ROUTES + 1


def told(exports: ServiceExports, peer: int = 1) -> list[AdvertiseServices]:
    found = []
    while exports.pending:
        sent = [action.message for action in exports.advertise() if isinstance(action, Send) and action.peer == peer]
        found += [message for message in sent if isinstance(message, AdvertiseServices)]
    return found


def opened(exports: ServiceExports) -> int:
    """Let peer 1 open /add; our route for its requests."""
    assert exports.opened(1, OpenService(ROUTE, "/add", 2.0)) == [Probe("/add", ADD)]
    serve, send = exports.described("/add", ADD, ABOUT)
    assert isinstance(serve, ServeRoute)
    assert send == Send(1, ServiceOpened(ROUTE, serve.requests, ABOUT.type, ABOUT.md5sum))
    assert serve == ServeRoute(1, ROUTE, serve.requests, "/add", ADD, 2.0)
    return serve.requests


@pytest.fixture
def exports() -> ServiceExports:
    made = ServiceExports(rules())
    made.graph("/add", ADD)
    made.link_up(1, "base")
    return made


def test_a_server_at_another_address_is_told_again_and_its_routes_end(exports: ServiceExports) -> None:
    requests = opened(exports)
    again = LocalService("/adder", "rosrpc://127.0.0.1:7")
    assert exports.graph("/add", again) == [
        EndRoute(1, requests), Send(1, ServiceClosed(ROUTE, "/add: its server has restarted")), ServerGone("/add"),
    ]  # fmt: skip
    assert told(exports) == [AdvertiseServices((ServiceOffer("/add", "/adder"),))]
    assert exports.opened(1, OpenService(ROUTE, "/add")) == [Probe("/add", again)]
    assert exports.described("/add", ADD, ABOUT) == [], "the answer of the one before"
    assert exports.refused("/add", ADD, "no answer") == [], "its late end fails no call of the next one"


def test_a_service_is_opened_at_once_when_its_server_is_known(exports: ServiceExports) -> None:
    first = opened(exports)
    exports.link_up(2, "arm")
    serve, send = exports.opened(2, OpenService(ROUTE, "/add"))
    assert isinstance(serve, ServeRoute)
    assert isinstance(send, Send)
    assert (serve.peer, serve.timeout, send.peer) == (2, config_limits.SERVICE_TIMEOUT, 2)
    assert exports.callers("/add") == (1, 2)
    assert exports.closed(1, CloseService(ROUTE)) == [EndRoute(1, first)]
    assert exports.closed(1, CloseService(ROUTE)) == [], "words that crossed"
    assert exports.callers("/add") == (2,)


def test_one_probe_answers_all_who_wait(exports: ServiceExports) -> None:
    exports.link_up(2, "arm")
    assert exports.opened(1, OpenService(ROUTE, "/add")) == [Probe("/add", ADD)]
    assert exports.opened(2, OpenService(ROUTE, "/add")) == []
    assert exports.refused("/add", ADD, "no answer") == [
        Send(1, ServiceClosed(ROUTE, "no answer")),
        Send(2, ServiceClosed(ROUTE, "no answer")),
    ]
    assert exports.opened(1, OpenService(ROUTE, "/add")) == [Probe("/add", ADD)], "whoever asks again has another try"
