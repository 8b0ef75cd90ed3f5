"""The publisher's side of direct transport, with doubles for the core, the peers and the local nodes."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from rmpa.bridge import limits
from rmpa.bridge.direct import grants
from rmpa.bridge.direct.grants import NodePorts, ServiceGrants, TopicGrants
from rmpa.bridge.direct.paths import Condition, DirectAsk, Grant, Unmet, Want
from rmpa.bridge.messages import Source
from rmpa.bridge.policy import PermissionGate
from rmpa.config.settings import TrustSettings
from rmpa.core.contract import Contract, Contracts, Transport
from rmpa.core.errors import RemoteProtocolError
from rmpa.core.statistics import Counters
from rmpa.ros.master.parameters import GraphChange, RegistrationKind
from rmpa.trust.permissions import Permissions

SOURCE = Source("/chatter", "/talker")
URI = "http://10.0.0.1:1234/"
WANT = Want("/chatter", "/talker", "/viewer")
AGAIN = "direct.topic_again"
AUTO = Contract(transport=Transport.AUTO)


class Module:
    """The module of /talker, and what its agent told its peers."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.publishers = {"/chatter": {"/talker": URI}}
        self.subscribers: dict[str, dict[str, str]] = {}
        self.offered = {SOURCE: SimpleNamespace(type="std_msgs/String", origin=None, uri=URI)}
        self.suspected: list[str] = []
        self.forgotten: list[str] = []
        self.told: list[tuple[int, str, dict[str, Any]]] = []
        self.ended: list[tuple[int, str]] = []
        self.asked: list[str] = []
        self.found: Grant | Unmet = Grant(45225, "/talker")
        self.gate = asyncio.Event()
        self.gate.set()
        self.handlers: dict[str, Any] = {}
        self.sessions = {number: self._session(number) for number in (1, 2)}
        self.permissions = PermissionGate()
        self.services: dict[str, dict[str, str]] = {}
        monkeypatch.setattr(grants, "connections", lambda local_port, remote: [(local_port, remote[0])])
        monkeypatch.setattr(grants, "end_all", self._end_all)
        monkeypatch.setattr(grants, "grant_at", lambda _, node, port, probe: Grant(port, node, probe))
        monkeypatch.setattr(NodePorts, "find", self._port)
        monkeypatch.setattr(NodePorts, "forget", lambda _, uri: self.forgotten.append(uri))
        self.context = SimpleNamespace(contracts=Contracts((), AUTO.transport), gate=self.permissions)
        self.sut = TopicGrants(
            cast(
                "Any",
                SimpleNamespace(
                    core=SimpleNamespace(
                        subscribers=lambda topic: self.subscribers.get(topic, {}),
                        publishers=lambda topic: self.publishers.get(topic, {}),
                        state=lambda: SimpleNamespace(services=self.services),
                        suspect=self.suspected.append,
                    ),
                    sessions=SimpleNamespace(get=self.sessions.get, linked=self.sessions.values),
                    rpc=SimpleNamespace(
                        on_request=self._on,
                        on_notification=self._on,
                        notify=lambda session, what, args: self.told.append((session.peer, what, args)),
                    ),
                    counters=Counters(),
                    context=self.context,
                ),
            ),
            cast("Any", SimpleNamespace(offered=self.offered, local=self._local)),
        )

    def reload(self, transport: Transport) -> None:
        """Other rules."""
        self.context.contracts = Contracts((), transport)
        self.sut.judge_again()

    def _on(self, what: str, handler: object, _needs: object) -> None:
        self.handlers[what] = handler

    def permit(self, trust: TrustSettings) -> None:
        """The mesh is secured, with these permissions."""
        self.permissions.permissions = Permissions(trust)

    @staticmethod
    def _session(number: int) -> Any:
        link = SimpleNamespace(name=f"peer{number}", crashed=False)
        return SimpleNamespace(
            peer=number,
            link=link,
            linked=True,
            silent=True,
            same_machine=False,
            address=f"10.0.0.{number}",
        )

    def _local(self, _peer: int, source: Source) -> Source | None:
        return source if source in self.offered else None

    def _end_all(self, found: list[tuple[int, str]]) -> str:
        self.ended += found
        return ""

    async def _port(self, _node: str, uri: str, _topic: str) -> int | Unmet:
        self.asked.append(uri)
        await self.gate.wait()
        return self.found.port if isinstance(self.found, Grant) else self.found

    async def open(
        self,
        peer: int = 1,
        subscriber: str = "/viewer",
        contract: Contract = AUTO,
        *,
        node: str = "/talker",
        broken: bool = False,
    ) -> dict[str, Any]:
        args = msgspec.to_builtins(DirectAsk("/chatter", node, subscriber, contract, broken))
        reply: dict[str, Any] = await self.handlers["direct.topic"](self.sessions[peer], args)
        return reply

    def close(self, peer: int = 1, subscriber: str = "/viewer") -> None:
        self.handlers["direct.topic_release"](self.sessions[peer], Want("/chatter", "/talker", subscriber)._asdict())

    def change(self, kind: RegistrationKind, node: str, uri: str, *, added: bool) -> None:
        graph = self.publishers if kind is RegistrationKind.PUBLISHER else self.subscribers
        nodes = graph.setdefault("/chatter", {})
        if added:
            nodes[node] = uri
        else:
            nodes.pop(node, None)
        self.sut.graph_changed(
            cast("GraphChange", SimpleNamespace(kind=kind, name="/chatter", node=node, api=uri, added=added))
        )

    @property
    def granted(self) -> list[tuple[int, str]]:
        return [(peer, want.user) for peer, want, _ in self.sut]


@pytest.fixture
def module(monkeypatch: pytest.MonkeyPatch) -> Module:
    return Module(monkeypatch)


@pytest.mark.trap(12)
async def test_a_subscriber_is_granted_the_publishers_port(module: Module) -> None:
    assert await module.open() == {"port": 45225, "probe": ""}
    assert module.granted == [(1, "/viewer")]
    assert (await module.open(2))["why"] == Condition.CALLER_ID
    module.close()
    assert [(peer, what) for peer, what, _ in module.told] == [(2, AGAIN)]
    assert await module.open(2) == {"port": 45225, "probe": ""}


async def test_what_is_not_offered_or_not_allowed_is_refused(module: Module) -> None:
    assert (await module.open(contract=Contract()))["why"] == Condition.TRANSPORT
    assert (await module.open(contract=Contract(transport=Transport.AUTO, max_rate=5.0)))["why"] == Condition.CONTRACT
    module.offered.clear()
    assert (await module.open())["why"] == Condition.OFFERED
    assert module.asked == []
    for args in ({"name": "x"}, WANT._asdict(), {"name": "/chatter", "node": "/talker", "contract": {}}):
        with pytest.raises(RemoteProtocolError):
            await module.handlers["direct.topic"](module.sessions[1], args)
    assert {peer: list(asked) for peer, asked in module.sut._asked.items()} == {1: [WANT]}, (
        "of malformed questions nothing is kept"
    )


async def test_only_a_peer_with_a_grant_may_have_a_node_examined(module: Module) -> None:
    module.found = Unmet(Condition.LISTENING, "loopback")
    await module.open(broken=True)
    assert (module.suspected, module.forgotten) == ([], [])
    module.found = Grant(45225, "/talker")
    await module.open()
    await module.open(2, broken=True)
    await module.open(subscriber="/other", broken=True)
    assert module.suspected == []
    await module.open(broken=True)
    assert (module.suspected, module.forgotten) == (["/talker"], [URI])


async def test_the_grants_and_the_remembered_refusals_of_a_peer_are_bounded(
    module: Module, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "DIRECT_MAX", 3)
    replies = [await module.open(subscriber=f"/s{number}") for number in range(10)]
    assert [reply.get("why") for reply in replies] == [None] * 3 + [Condition.LIMIT] * 7
    assert await module.open(2) == {"port": 45225, "probe": ""}, "each peer has its own bound"
    assert len(module.sut._asked[1]) == 6


async def test_a_secured_mesh_has_no_plain_connections_unless_both_allow_it(module: Module) -> None:
    module.permit(TrustSettings())
    refused = await module.open()
    assert refused["why"] == Condition.TRUST
    assert "trust.direct is false in the publisher's module" in refused["text"]
    module.sessions[1].same_machine = True
    assert await module.open() == {"port": 45225, "probe": ""}, "it does not leave the machine"
    module.permit(TrustSettings(direct=True))
    assert await module.open(2, "/other") == {"port": 45225, "probe": ""}


async def test_a_reload_of_a_secured_mesh_withdraws_grants_and_ends_their_connections(module: Module) -> None:
    module.permit(TrustSettings(direct=True))
    await module.open(1)
    await module.open(2, "/other")
    module.sessions[2].same_machine = True
    module.told.clear()
    module.permit(TrustSettings(direct=False))
    module.reload(Transport.AUTO)
    assert module.granted == [(2, "/other")], "the other one is on this machine"
    assert [told[:2] for told in module.told] == [(1, AGAIN)]
    assert module.ended == [(45225, "10.0.0.1")]
    module.offered.clear()
    module.sut.judge_again(refused=False)
    assert module.granted == []
    assert module.ended == [(45225, "10.0.0.1")], "all nodes of a machine have one address"


async def test_without_trust_a_withdrawn_connection_is_left_to_the_peers_agent(module: Module) -> None:
    await module.open(1)
    module.offered.clear()
    module.sut.judge_again(refused=False)
    assert (module.granted, module.ended) == ([], [])


async def test_a_secured_peer_does_not_learn_when_a_topic_that_it_may_not_have_is_published(module: Module) -> None:
    module.permit(TrustSettings(direct=True))
    module.offered.clear()
    assert (await module.open())["why"] == Condition.OFFERED
    module.change(RegistrationKind.PUBLISHER, "/talker", URI, added=False)
    module.change(RegistrationKind.PUBLISHER, "/talker", URI, added=True)
    module.reload(Transport.AUTO)
    assert module.told == []


@pytest.mark.parametrize("secured", [True, False])
async def test_a_secured_peer_does_not_learn_of_a_service_that_it_may_not_have(
    module: Module, *, secured: bool
) -> None:
    if secured:
        module.permit(TrustSettings())
    transports = iter((Transport.AUTO, Transport.DIRECT))
    module.context.services = SimpleNamespace(transport=lambda _: next(transports))
    server = SimpleNamespace(node="/adder", uri=URI, origin=None)
    exports = SimpleNamespace(offered={"/add": server}, local=lambda *_: None)
    warnings: list[str] = []
    services = ServiceGrants(module.sut._bridge, cast("Any", exports), lambda *words: warnings.append(words[0]))
    for expected in ([], ["direct.relayed"]):
        reply = await module.handlers["direct.service"](module.sessions[1], {"name": "/add", "node": "/adder"})
        assert reply["why"] == Condition.OFFERED
        assert warnings == expected
    services.server_gone("/add")
    assert [(peer, what) for peer, what, _ in module.told] == ([] if secured else [(1, "direct.service_again")])
