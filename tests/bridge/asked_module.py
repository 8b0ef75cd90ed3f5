"""Stands for a module whose peers are asked, and answer as the test says."""

from __future__ import annotations

import inspect
import random
from types import SimpleNamespace
from typing import Any

from rmpa.bridge.data.reception import LinkTime
from rmpa.bridge.policy import OPEN_GATE, BridgeContext, PermissionGate
from rmpa.bridge.rpc import PeerRpc
from rmpa.config.peer_rules import PermissionRule
from rmpa.config.settings import Settings, TrustSettings
from rmpa.core.statistics import Counters
from rmpa.trust.permissions import Permissions


class Peers(list[Any]):
    """The sessions of the peers."""

    def linked(self) -> list[Any]:
        return [one for one in self if one.linked]


class AskedModule(PeerRpc):
    """One module beside a bridge that is made up, and the questions to its peers and to itself.

    Args:
        settings: Its settings.
        rules: Its permissions.
        secured: Whether the mesh is secured; by default if there are rules.
        default: As of ``trust.default``.
        parts: What else the bridge has.

    Attributes:
        bridge: The bridge.
        asked: What peers were asked, with the arguments.
    """

    def __init__(
        self, settings: Settings, *rules: PermissionRule, secured: bool = False, default: str = "deny", **parts: Any
    ) -> None:
        super().__init__(Counters())
        trust = TrustSettings(default, rules=rules)
        gate = PermissionGate(Permissions(trust)) if rules or secured else OPEN_GATE
        self.peers, self._answers = Peers(), dict[str, Any]()
        self.asked: list[tuple[str, dict[str, Any]]] = []
        context = BridgeContext.of(settings, gate)
        self.bridge: Any = SimpleNamespace(rpc=self, context=context, sessions=self.peers, rng=random.random, **parts)

    def peer(self, name: str, answer: Any = "", *, ahead: float = 0.0, linked: bool = True) -> Any:
        """Link a peer, or have it answer otherwise; an exception is raised, a function gets the arguments."""
        self._answers[name] = answer
        time = LinkTime()
        time.set(ahead, 0.002)
        link = SimpleNamespace(name=name, guid=f"guid of {name}")
        session = SimpleNamespace(link=link, time=time, linked=linked, peer=len(self.peers) + 1)
        self.peers[:] = [*(one for one in self.peers if one.link.name != name), session]
        return session

    async def request(self, session: Any, what: str, args: dict[str, Any], timeout: float = 0.0) -> Any:
        self.asked.append((what, args))
        answer = self._answers[session.link.name]
        if isinstance(answer, Exception):
            raise answer
        return answer(args) if callable(answer) else answer

    async def answer(self, asker: str, what: str, args: dict[str, Any]) -> Any:
        """What a peer that asks is answered."""
        session: Any = SimpleNamespace(link=SimpleNamespace(name=asker))
        found: Any = self.handlers[what](session, args)
        return await found if inspect.isawaitable(found) else found
