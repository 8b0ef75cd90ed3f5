"""The subscriber's side of direct transport, with doubles for the core, the peer, the kernel and the nodes."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from rmpa.bridge import limits
from rmpa.bridge.direct import requests
from rmpa.bridge.direct.conditions import Condition, Unmet
from rmpa.bridge.direct.direct_route import DirectKey, DirectState, Path
from rmpa.bridge.direct.requests import DirectClosed
from rmpa.bridge.messages import Source
from rmpa.bridge.topics.io import direct_importer
from rmpa.bridge.topics.io.direct_importer import DirectImporter
from rmpa.core.contract import Contracts, Transport
from rmpa.core.counters import Counters
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.ros.wire.xmlrpc import RosReply
from tests.ros.node.peers import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

SOURCE = Source("/chatter", "/talker")
KEY = DirectKey(1, SOURCE, "/viewer")
END = ("10.0.0.1", 45225)
DIRECT = RosReply(1, "ready on 10.0.0.1:45225", ["TCPROS", "10.0.0.1", 45225])


class Module:
    """The module of /viewer; its peer 1 offers /chatter of /talker."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.subscribers = {"/chatter": {"/viewer": "http://10.0.0.2:1/"}}
        self.entry = self._entry()
        self.value: object = {"port": 45225, "probe": "/talker/get_loggers", "address": "10.0.0.9"}
        self.gate = asyncio.Event()
        self.gate.set()
        self.reachable = asyncio.Event()
        self.reachable.set()
        self.asking = self.most = 0
        self.probed: list[tuple[str, int]] = []
        self.moved: list[DirectKey] = []
        self.told: list[str] = []
        self.warned: list[str] = []
        self.connected: list[object] = []
        self.checked = asyncio.Event()
        link = SimpleNamespace(name="a", reachable=True)
        self.session: Any = SimpleNamespace(
            peer=1, link=link, linked=True, reachable=True, same_machine=False, address="10.0.0.1"
        )
        self.callers: frozenset[str] = frozenset()
        publication = SimpleNamespace(callers=self.callers, listeners=())
        monkeypatch.setattr(direct_importer, "probe", self._probe)
        monkeypatch.setattr(direct_importer, "standing", lambda _: {40_000} if self.connected else set())
        monkeypatch.setattr(direct_importer, "direct_links", self._direct_links)
        monkeypatch.setattr(direct_importer, "end_links", self._end_links)
        self.imports = SimpleNamespace(get=lambda *_: self.entry, at=lambda _: [(1, SOURCE)])
        state = SimpleNamespace(subscribers=self.subscribers, publishers={}, nodes={})
        self.sut = DirectImporter(
            cast(
                "Any",
                SimpleNamespace(
                    state=lambda: state,
                    subscribers=lambda topic: state.subscribers.get(topic, {}),
                    publishers=lambda _: {},
                    suspect=lambda _: None,
                    node_host="127.0.0.1",
                ),
            ),
            cast("Any", self.imports),
            cast("Any", {1: SimpleNamespace(publication=lambda _: publication)}),
            Contracts((), Transport.AUTO),
            cast("Any", SimpleNamespace(get={1: self.session}.get)),
            cast(
                "Any",
                SimpleNamespace(
                    on_notification=lambda *_: None,
                    request=self._request,
                    notify=lambda _session, what, _args: self.told.append(what),
                ),
            ),
            on_demand=lambda *_: None,
            on_warning=lambda _kind, _subject, text: self.warned.append(text),
            counters=Counters(),
        )
        monkeypatch.setattr(self.sut._moves, "move", self.moved.append)

    @staticmethod
    def _entry() -> Any:
        return SimpleNamespace(
            topic="/chatter", type="std_msgs/String", shown=True, origin=None, description=None, direct=False
        )

    async def _request(self, *_: object) -> object:
        self.asking += 1
        self.most = max(self.most, self.asking)
        try:
            await self.gate.wait()
        finally:
            self.asking -= 1
        if isinstance(self.value, RmpaError):
            raise self.value
        return self.value

    async def _probe(self, address: str, port: int, *_: object, **__: object) -> str:
        self.probed.append((address, port))
        link = self.session.link
        await self.reachable.wait()
        return "" if link.reachable else "no answer"

    async def _direct_links(self, *_: object) -> list[object]:
        self.checked.set()
        await asyncio.sleep(0)
        return self.connected

    async def _end_links(self, *_: object) -> str:
        self.connected = []
        return ""

    async def ask(self) -> RosReply | None:
        answer = self.sut.request(1, SOURCE, "/viewer")
        return await answer if answer is not None else None

    @property
    def state(self) -> tuple[DirectState, Path]:
        route = self.sut.routes.get(KEY)
        assert route is not None
        return route.state, route.path


@pytest.fixture
async def module(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Module]:
    made = Module(monkeypatch)
    yield made
    await made.sut.close()


async def test_a_subscriber_waits_for_the_decision_and_is_sent_to_the_links_own_address(module: Module) -> None:
    module.gate.clear()
    module.sut.shown(1, SOURCE)
    asking = asyncio.create_task(module.ask())
    await until(lambda: module.asking)
    module.gate.set()
    assert await asking == DIRECT, "not to the address in the peer's answer"
    assert module.probed == [END]
    assert module.state == (DirectState.DIRECT, Path.DIRECT)


async def test_one_that_has_waited_for_too_long_is_relayed_and_moved_later(
    module: Module, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "DIRECT_HOLD", 0.01)
    module.gate.clear()
    module.sut.shown(1, SOURCE)
    assert await module.ask() is None
    assert module.state == (DirectState.ASKING, Path.RELAY)
    module.gate.set()
    await until(lambda: module.moved == [KEY])


async def test_a_withdrawal_while_the_answer_is_made_is_not_overlooked(module: Module) -> None:
    module.sut.shown(1, SOURCE)
    await until(lambda: module.state[0] is DirectState.DIRECT)
    module.connected = [SimpleNamespace(local_port=40_000)]
    asking = asyncio.create_task(module.ask())
    await module.checked.wait()
    args = requests.write(DirectClosed("/chatter", "/talker", "", "caller_id", "another"))
    module.sut._closed_there(module.session, args)
    assert await asking is None
    assert module.state == (DirectState.RELAYED, Path.RELAY)
    assert module.connected == [], "the direct connection has ended before"


async def test_one_that_is_connected_already_gets_no_second_connection(module: Module) -> None:
    module.sut.shown(1, SOURCE)
    await until(lambda: module.state[0] is DirectState.DIRECT)
    module.connected = [SimpleNamespace(local_port=40_000)]
    reply = await module.ask()
    assert reply is not None
    assert reply.code == 0
    assert module.state == (DirectState.DIRECT, Path.DIRECT)


async def test_only_so_many_requests_wait_for_a_peer(module: Module) -> None:
    module.gate.clear()
    module.subscribers["/chatter"] |= {f"/n{number}": "http://10.0.0.2:1/" for number in range(200)}
    module.sut.shown(1, SOURCE)
    await until(lambda: module.asking == limits.DIRECT_ASKS)
    module.gate.set()
    await until(lambda: all(route.state is DirectState.DIRECT for _, route in module.sut.routes))
    assert module.most == limits.DIRECT_ASKS
    assert module.probed == [END], "a port is probed once"


@pytest.mark.parametrize(
    ("value", "condition"),
    [
        (PeerRefused("a", "this agent does not know the question 'direct.open'"), Condition.RELEASE),
        (PeerRefused("a", "too many questions at once"), Condition.AGENT),
        (UnreachableError("agent", "a"), Condition.AGENT),
        ({"port": 0}, Condition.RELEASE),
        ({"why": "caller_id", "text": "another"}, Condition.CALLER_ID),
    ],
)
async def test_why_a_peer_grants_nothing_decides_whether_it_is_asked_again(
    module: Module, value: object, condition: Condition
) -> None:
    module.value = value
    module.sut.shown(1, SOURCE)
    assert await module.ask() is None
    decision = module.sut.routes.decision(KEY)
    assert isinstance(decision, Unmet)
    assert decision.condition is condition
    assert (module.sut.routes.next_timer() is None) is decision.lasting


async def test_a_source_is_kept_only_while_its_own_agent_is_dead(module: Module) -> None:
    module.sut.shown(1, SOURCE)
    assert await module.ask() == DIRECT
    module.sut.link_down(module.session, crashed=True)
    assert module.entry.direct
    other = SimpleNamespace(**{**vars(module.session), "peer": 2})
    module.sut.link_up(cast("Any", other))
    assert module.entry.direct, "the link of another peer changes nothing"
    module.sut.link_up(module.session)
    assert not module.entry.direct
    await until(lambda: module.state == (DirectState.DIRECT, Path.DIRECT))
    assert module.moved == []


async def test_an_interruption_by_a_lost_link_is_told_after_it(module: Module) -> None:
    module.sut.shown(1, SOURCE)
    assert await module.ask() == DIRECT
    assert module.sut.interruptions.get("a", *KEY[1:]) is None
    module.sut.link_down(module.session, crashed=False)
    module.sut.hidden(1, SOURCE)
    lasting = module.sut.interruptions.get("a", *KEY[1:])
    assert lasting is not None
    assert (lasting.count, lasting.ended) == (1, None)
    module.sut.shown(1, SOURCE)
    module.sut.link_up(module.session)
    assert await module.ask() == DIRECT
    assert lasting.ended is not None


async def test_a_probe_over_an_earlier_link_does_not_count_for_the_next_one(module: Module) -> None:
    module.reachable.clear()
    module.sut.shown(1, SOURCE)
    await until(lambda: module.probed)
    early = module.reachable
    module.reachable = asyncio.Event()
    module.sut.link_down(module.session, crashed=False)
    module.session.link = SimpleNamespace(name="a", reachable=False)
    module.sut.link_up(module.session)
    await until(lambda: len(module.probed) == 2)
    early.set()  # it has reached the port, before the link was lost
    await asyncio.sleep(0)
    module.reachable.set()
    await until(lambda: module.state[0] is DirectState.RELAYED)


async def test_a_subscriber_that_ends_frees_its_grant(module: Module) -> None:
    module.sut.shown(1, SOURCE)
    assert await module.ask() == DIRECT
    module.sut.hidden(1, SOURCE)
    assert requests.CLOSE in module.told
    assert list(module.sut.routes) == []


@pytest.mark.parametrize("taken_over", [True, False])
async def test_what_a_crashed_agent_left_is_taken_over_or_ended(
    module: Module, monkeypatch: pytest.MonkeyPatch, *, taken_over: bool
) -> None:
    monkeypatch.setattr(limits, "DIRECT_ADOPT", 0.05)
    module.sut.shown(1, SOURCE)
    assert await module.ask() == DIRECT
    module.connected = [SimpleNamespace(local_port=40_000)]
    module.sut.link_down(module.session, crashed=True)
    module.sut.gone(module.session, hang_up=False)
    if taken_over:
        module.sut.shown(1, SOURCE)
        reply = await module.ask()
        assert reply is not None
        assert reply.code == 0, "it stays connected"
        assert module.sut._strays == {}
        assert module.connected
    else:
        await until(lambda: not module.connected)


async def test_a_subscriber_that_the_next_agent_relays_has_lost_its_direct_connection_before(module: Module) -> None:
    module.sut.shown(1, SOURCE)
    assert await module.ask() == DIRECT
    module.connected = [SimpleNamespace(local_port=40_000)]
    module.sut.link_down(module.session, crashed=True)
    module.sut.gone(module.session, hang_up=False)
    module.value = {"why": "listening", "text": "loopback"}
    module.sut.shown(1, SOURCE)
    assert await module.ask() is None
    assert module.connected == []
