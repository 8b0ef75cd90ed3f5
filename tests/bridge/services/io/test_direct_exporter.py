"""The server's side of direct calls, with doubles for the peers and the offered services: what a peer is told."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from rmpa.bridge.direct.conditions import Condition, DirectAsk
from rmpa.bridge.direct.grants import ServiceGrants
from rmpa.bridge.policy import PermissionGate
from rmpa.config.settings import TrustSettings
from rmpa.core.contract import Transport
from rmpa.core.counters import Counters
from rmpa.trust.permissions import Permissions

AGAIN = "direct.service_again"
URI, RESTARTED = "rosrpc://10.0.0.1:45000", "rosrpc://10.0.0.1:45001"


class Module:
    """The module of /adder, which provides /add, and what its agent told peer 1."""

    def __init__(self, *, secured: bool) -> None:
        self.permitted = False
        self.told: list[str] = []
        self.handlers: dict[str, Any] = {}
        self.offered = {"/add": SimpleNamespace(node="/adder", uri=URI, origin=None)}
        link = SimpleNamespace(name="pad")
        self.session: Any = SimpleNamespace(peer=1, link=link, linked=True, same_machine=False, address="10.0.0.2")
        trust = Permissions(TrustSettings()) if secured else None
        local = lambda _, service: service if self.permitted else None  # noqa: E731 - a double
        rpc = SimpleNamespace(
            on_request=self._on,
            on_notification=self._on,
            notify=lambda _, what, __: self.told.append(what),
        )
        self.sut = ServiceGrants(
            cast(
                "Any",
                SimpleNamespace(
                    sessions=SimpleNamespace(get={1: self.session}.get),
                    rpc=rpc,
                    counters=Counters(),
                    context=SimpleNamespace(
                        gate=PermissionGate(trust), services=SimpleNamespace(transport=lambda _: Transport.AUTO)
                    ),
                ),
            ),
            cast("Any", SimpleNamespace(offered=self.offered, local=local)),
            lambda *_: None,
        )

    def _on(self, what: str, handler: object, _needs: object) -> None:
        self.handlers[what] = handler

    async def ask(self) -> str:
        """Peer 1 asks for a direct call; returns the condition that is not met."""
        reply = await self.handlers["direct.service"](self.session, msgspec.to_builtins(DirectAsk("/add", "/adder")))
        return str(reply["why"])

    def restart(self) -> None:
        """The server is registered again, at another port."""
        self.sut.server_gone("/add")


@pytest.mark.parametrize("secured", [True, False])
async def test_a_secured_peer_does_not_learn_of_a_service_that_it_may_not_have(*, secured: bool) -> None:
    module = Module(secured=secured)
    assert await module.ask() == Condition.OFFERED
    module.restart()
    assert module.told == ([] if secured else [AGAIN])


async def test_a_secured_peer_is_told_when_to_ask_again_for_a_service_that_it_may_have() -> None:
    module = Module(secured=True)
    module.permitted = True
    assert await module.ask() == Condition.TRUST
    module.restart()
    assert module.told == [AGAIN]


async def test_what_a_reload_forbids_is_forgotten() -> None:
    module = Module(secured=True)
    module.permitted = True
    assert await module.ask() == Condition.TRUST
    module.permitted = False
    module.sut.judge_again()
    module.restart()
    assert module.told == []
