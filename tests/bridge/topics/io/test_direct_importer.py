"""The subscriber's side of direct transport, with doubles for the core, the peer, the kernel and the nodes."""

from __future__ import annotations

import asyncio
import math
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from rmpa.bridge import limits
from rmpa.bridge.direct.conditions import Condition, Want
from rmpa.bridge.messages import Source
from rmpa.bridge.policy import OPEN_GATE
from rmpa.bridge.topics import direct as direct_importer
from rmpa.bridge.topics.direct import TopicPaths
from rmpa.core.contract import Contracts, Transport
from rmpa.core.errors import PeerRefused, RmpaError, UnreachableError
from rmpa.core.statistics import Counters
from rmpa.ros.wire.xmlrpc import RosReply
from tests.waiting import until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from rmpa.bridge.direct.paths import Path

SOURCE = Source("/chatter", "/talker")
WANT = Want("/chatter", "/talker", "/viewer")
END = ("10.0.0.1", 45225)
LINK = SimpleNamespace(
    inbound=True, topic="/chatter", connected=True, other="http://10.0.0.2:9/", remote=END, local_port=40_000
)
DIRECT = RosReply(1, "ready on 10.0.0.1:45225", ["TCPROS", "10.0.0.1", 45225])


class Imports:
    """The one source of the peer."""

    def __init__(self, module: Module) -> None:
        self._module = module

    def __iter__(self) -> Iterator[Any]:
        yield self._module.entry

    def get(self, *_: object) -> Any:
        return self._module.entry

    def at(self, _topic: str) -> list[Any]:
        return [self._module.entry] if self._module.entry is not None else []


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
        self.moved: list[str] = []
        self.told: list[str] = []
        self.warned: list[str] = []
        self.connected: list[object] = []
        self.checked = asyncio.Event()
        link = SimpleNamespace(name="a", reachable=True, crashed=True)
        self.session: Any = SimpleNamespace(
            peer=1,
            link=link,
            linked=True,
            same_machine=False,
            address="10.0.0.1",
            proxies=SimpleNamespace(get=lambda _: None),
        )
        monkeypatch.setattr(direct_importer, "probe", self._probe)
        monkeypatch.setattr(direct_importer, "standing", lambda *_: {45225: {40_000}} if self.connected else {})
        monkeypatch.setattr(direct_importer, "bus_links", self._bus_links)
        monkeypatch.setattr(direct_importer, "end_link", self._end_link)
        self.imports = Imports(self)
        shared = SimpleNamespace(
            core=SimpleNamespace(
                subscribers=lambda topic: self.subscribers.get(topic, {}),
                publishers=lambda _: {},
                suspect=lambda _: None,
                node_host="127.0.0.1",
            ),
            sessions=SimpleNamespace(get={1: self.session}.get),
            rpc=SimpleNamespace(
                on_notification=lambda *_: None,
                request=self._request,
                notify=lambda _session, what, _args: self.told.append(what),
            ),
            counters=Counters(),
            context=SimpleNamespace(contracts=Contracts((), Transport.AUTO), gate=OPEN_GATE),
        )
        self.sut = TopicPaths(
            cast("Any", shared),
            lambda _kind, _subject, text: self.warned.append(text),
            cast("Any", self.imports),
        )
        monkeypatch.setattr(self.sut, "_renew", self._renew)

    async def _renew(self, path: Path[Any]) -> bool:
        self.moved.append(path.want.user)
        return False

    @staticmethod
    def _entry() -> Any:
        return SimpleNamespace(
            peer=1,
            wire=SOURCE,
            name="/chatter",
            node="/talker",
            type="std_msgs/String",
            shown=True,
            origin=None,
            description=None,
            direct=False,
            publication=SimpleNamespace(callers=frozenset(), listeners=(), hang_up=lambda _: None),
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

    async def _bus_links(self, *_: object) -> list[object]:
        self.checked.set()
        await asyncio.sleep(0)
        return self.connected

    async def _end_link(self, *_: object) -> str:
        self.connected = []
        return ""

    async def ask(self) -> RosReply | None:
        answer = self.sut.request(1, SOURCE, "/viewer")
        return await answer if answer is not None else None

    @property
    def path(self) -> Path[Any]:
        found = self.sut.get(1, WANT)
        assert found is not None
        return found

    @property
    def state(self) -> tuple[str, tuple[str, int] | None]:
        return self.path.state, self.path.endpoint


@pytest.fixture
async def module(monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Module]:
    made = Module(monkeypatch)
    yield made
    await made.sut.close()


async def test_a_subscriber_waits_for_the_decision_and_is_sent_to_the_links_own_address(module: Module) -> None:
    module.gate.clear()
    module.sut.shown(module.entry)
    asking = asyncio.create_task(module.ask())
    await until(lambda: module.asking)
    module.gate.set()
    assert await asking == DIRECT, "not to the address in the peer's answer"
    assert module.probed == [END]
    assert module.state == ("direct", END)


async def test_one_that_has_waited_for_too_long_is_relayed_and_moved_later(
    module: Module, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "DIRECT_HOLD", 0.01)
    module.gate.clear()
    module.sut.shown(module.entry)
    assert await module.ask() is None
    assert module.state == ("asking", None)
    module.gate.set()
    await until(lambda: module.moved == ["/viewer"])


async def test_a_withdrawal_while_the_answer_is_made_is_not_overlooked(module: Module) -> None:
    module.sut.shown(module.entry)
    await until(lambda: module.state[0] == "direct")
    module.connected = [LINK]
    asking = asyncio.create_task(module.ask())
    await module.checked.wait()
    module.value = {"why": "caller_id", "text": "another"}
    module.path.asked_at = -math.inf
    module.sut._asked_again(module.session, WANT._asdict())
    await until(lambda: module.state[0] == "relayed")
    module.gate.set()
    await asking
    assert module.moved == ["/viewer"]


async def test_one_that_is_connected_already_gets_no_second_connection(module: Module) -> None:
    module.sut.shown(module.entry)
    await until(lambda: module.state[0] == "direct")
    module.connected = [LINK]
    reply = await module.ask()
    assert reply is not None
    assert reply.code == 0
    assert module.state == ("direct", END)


async def test_only_so_many_requests_wait_for_a_peer(module: Module) -> None:
    module.gate.clear()
    module.subscribers["/chatter"] |= {f"/n{number}": "http://10.0.0.2:1/" for number in range(200)}
    module.sut.shown(module.entry)
    await until(lambda: module.asking == limits.DIRECT_ASKS)
    module.gate.set()
    await until(lambda: all(path.state == "direct" for path in module.sut))
    assert module.most == limits.DIRECT_ASKS
    assert len(module.probed) < limits.DIRECT_ASKS, "those that ask at a time share a probe"


@pytest.mark.parametrize(
    ("value", "condition"),
    [
        (PeerRefused("a", "this agent does not know the question 'direct.topic'"), Condition.RELEASE),
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
    module.sut.shown(module.entry)
    assert await module.ask() is None
    unmet = module.path.unmet
    assert unmet is not None
    assert unmet.condition is condition
    assert (module.path.retry is None) is unmet.lasting


async def test_a_source_is_kept_only_while_its_own_agent_is_dead(module: Module) -> None:
    module.sut.shown(module.entry)
    assert await module.ask() == DIRECT
    module.sut.link_down(module.session)
    assert module.entry.direct
    other = SimpleNamespace(**{**vars(module.session), "peer": 2})
    module.sut.link_up(cast("Any", other))
    assert module.entry.direct, "the link of another peer changes nothing"
    module.sut.link_up(module.session)
    assert not module.entry.direct
    await until(lambda: module.state == ("direct", END))
    assert module.moved == []


async def test_an_interruption_by_a_lost_link_is_told_after_it(module: Module) -> None:
    module.sut.shown(module.entry)
    assert await module.ask() == DIRECT
    assert module.sut.interruptions.get(("a", WANT)) is None
    module.session.link.crashed = False
    module.sut.link_down(module.session)
    module.sut.hidden(module.entry)
    count, _, ended = module.sut.interruptions["a", WANT]
    assert (count, ended) == (1, None)
    module.sut.shown(module.entry)
    module.sut.link_up(module.session)
    assert await module.ask() == DIRECT
    assert module.sut.interruptions["a", WANT][2] is not None


async def test_a_probe_over_an_earlier_link_does_not_count_for_the_next_one(module: Module) -> None:
    module.reachable.clear()
    module.sut.shown(module.entry)
    await until(lambda: module.probed)
    early = module.reachable
    module.reachable = asyncio.Event()
    module.session.link.crashed = False
    module.sut.link_down(module.session)
    module.session.link = SimpleNamespace(name="a", reachable=False, crashed=True)
    module.sut.link_up(module.session)
    await until(lambda: len(module.probed) == 2)
    early.set()  # it has reached the port, before the link was lost
    await asyncio.sleep(0)
    module.reachable.set()
    await until(lambda: module.state[0] == "relayed")


async def test_a_subscriber_that_ends_frees_its_grant(module: Module) -> None:
    module.sut.shown(module.entry)
    assert await module.ask() == DIRECT
    module.sut.hidden(module.entry)
    assert "direct.topic_release" in module.told
    assert list(module.sut) == []


async def test_a_grant_that_has_no_use_any_more_is_released(module: Module) -> None:
    module.sut._asked_again(module.session, {"name": "/chatter", "node": "/talker", "user": "/gone"})
    assert module.told == ["direct.topic_release"]


async def test_a_subscriber_that_the_next_agent_relays_has_lost_its_direct_connection_before(module: Module) -> None:
    module.sut.shown(module.entry)
    assert await module.ask() == DIRECT
    module.connected = [LINK]
    module.sut.link_down(module.session)
    module.sut.gone(module.session)
    module.value = {"why": "listening", "text": "loopback"}
    module.sut.shown(module.entry)
    assert await module.ask() is None
    assert module.connected == []


async def test_a_connection_to_an_earlier_address_of_the_peer_ends(
    module: Module, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def listed(*_: object) -> bool:
        return True

    monkeypatch.setattr(direct_importer, "publisher_update", listed)
    monkeypatch.setattr(
        direct_importer, "standing", lambda address, _=None: {45225: {40_000}} if address == END[0] else {}
    )
    module.sut.shown(module.entry)
    assert await module.ask() == DIRECT
    module.connected = [LINK]
    module.session.address = "10.1.0.1"  # its next link came by another network
    module.sut.hidden(module.entry)
    await until(lambda: module.connected == [])
