"""Questions about other sites: a module asks its gateways; a gateway answers, and judges who asks."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rmpa.bridge.policy import OPEN_GATE
from rmpa.core.errors import ConfigError, PeerRefused, RmpaError, UnreachableError
from rmpa.observe.sites import REPORT, SITE_INFO, SiteRequests


def peer(name: str) -> Any:
    return SimpleNamespace(link=SimpleNamespace(name=name, guid=f"guid of {name}"))


@dataclass
class Rpc:
    """Requests to peers: each answers, or refuses."""

    replies: dict[str, Any]

    def __post_init__(self) -> None:
        self.asked: list[str] = []
        self.handlers: dict[str, Any] = {}

    def on_request(self, what: str, handler: Any, _needs: object) -> None:
        self.handlers[what] = handler

    async def request(self, session: Any, what: str, args: dict[str, Any], timeout: float) -> Any:
        name = session.link.name
        self.asked.append(name)
        reply = self.replies[name]
        if isinstance(reply, RmpaError):
            raise reply
        return reply


class Gate:
    """Believes ``gate`` about other sites."""

    def may_relay(self, relay: str) -> bool:
        return relay == "gate"


class Gateway:
    def __init__(self) -> None:
        self.answered: list[tuple[str, str]] = []

    async def answer(self, what: str, _args: dict[str, Any], asker: str = "", /) -> object:
        self.answered.append((what, asker))
        return "answer"


def requests(rpc: Rpc, *peers: str, gate: Gate | None = None) -> SiteRequests:
    sessions = SimpleNamespace(linked=lambda: [peer(name) for name in peers])
    return SiteRequests(cast("Any", SimpleNamespace(rpc=rpc, sessions=sessions, gate=gate or OPEN_GATE)))


NO_GATEWAY = PeerRefused("arm", "this agent does not know the question 'site.info'")


async def test_the_peer_that_is_a_gateway_answers_and_is_asked_first_the_next_time() -> None:
    rpc = Rpc({"arm": NO_GATEWAY, "gate": {"x": 1}})
    asks = requests(rpc, "arm", "gate")
    args = {"what": SITE_INFO, "args": {"site": "hall"}}
    assert await asks.answer(args) == {"x": 1}
    assert await asks.answer(args) == {"x": 1}
    assert rpc.asked == ["arm", "gate", "gate"]
    assert await asks.answer({"what": REPORT, "args": {}}) == [{"x": 1}]


async def test_no_member_but_the_relays_is_believed_about_other_sites() -> None:
    """It would answer for every site."""
    rpc = Rpc({"eve": {"x": 666}, "gate": {"x": 1}})
    asks = requests(rpc, "eve", "gate", gate=Gate())
    assert await asks.one(SITE_INFO, {"site": "hall"}) == {"x": 1}
    assert await asks.all(REPORT, {}) == [{"x": 1}]
    assert rpc.asked == ["gate", "gate"]
    with pytest.raises(UnreachableError, match=r"`relays` of \[trust\]"):
        await requests(rpc, "eve", gate=Gate()).one(SITE_INFO, {"site": "hall"})


async def test_the_error_of_a_gateway_goes_before_that_of_others() -> None:
    rpc = Rpc({"arm": NO_GATEWAY, "gate": PeerRefused("gate", "site hall is unreachable since 3 s")})
    with pytest.raises(PeerRefused, match="site hall is unreachable"):
        await requests(rpc, "arm", "gate").one(SITE_INFO, {"site": "hall"})
    with pytest.raises(UnreachableError, match="no gateway answers at any linked peer"):
        await requests(rpc, "arm").one(SITE_INFO, {"site": "hall"})
    assert await requests(rpc, "arm").all(REPORT, {}) == []
    with pytest.raises(ConfigError):
        await requests(rpc).answer({"what": "site.shout", "args": {}})


async def test_a_gateway_answers_itself_and_is_told_which_module_asks() -> None:
    rpc, gateway = Rpc({}), Gateway()
    asks = requests(rpc, gate=Gate())
    asks.serve(gateway)
    assert await asks.answer({"what": REPORT, "args": {}}) == ["answer"]

    async def ask(who: str, what: str, args: dict[str, Any]) -> object:
        return await rpc.handlers[what](peer(who), args)

    assert await ask("other", SITE_INFO, {"asker": "desk"}) == "answer"
    assert gateway.answered == [(REPORT, ""), (SITE_INFO, "other")]
