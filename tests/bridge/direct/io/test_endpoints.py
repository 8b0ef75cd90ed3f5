"""Where a local node may be reached by a peer: asked of real slave nodes, and of the kernel."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from rmpa.bridge import limits
from rmpa.bridge.direct.conditions import Condition, Grant, Unmet, Want
from rmpa.bridge.direct.grants import NodePorts, ServiceGrants, grant_at
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.wire.xmlrpc import RosReply
from tests.ros.node.peers import STRING

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable


def seen_at(own_address: str) -> Any:
    """A peer that reaches this module at an address."""
    return SimpleNamespace(peer=1, own_address=own_address)


class Talker(PublicationEvents):
    """A node that publishes /t, and the endpoints of its module."""

    def __init__(self, host: str = "127.0.0.1") -> None:
        self.node = SlaveNode("/talker", host, "")
        self.asked: list[str] = []
        self.answer: RosReply | None = None
        self.node.add_publication(Publication("/t", "/talker", STRING, events=self))
        self.ports = NodePorts()

    def request(self, caller: str) -> Awaitable[RosReply | None]:
        self.asked.append(caller)

        async def reply() -> RosReply | None:
            return self.answer

        return reply()

    @property
    def port(self) -> int:
        address = self.node.address_of("/t")
        assert address is not None
        return address[1]

    async def find(self, own_address: str = "127.0.0.1") -> Grant | Unmet:
        port = await self.ports.find("/talker", self.node.uri, "/t")
        return port if isinstance(port, Unmet) else grant_at(seen_at(own_address), "/talker", port, "")


@pytest.fixture
async def talker() -> AsyncIterator[Talker]:
    made = Talker()
    await made.node.start()
    yield made
    await made.ports.close()
    await made.node.close()


def condition(found: Grant | Unmet) -> Condition:
    assert isinstance(found, Unmet), found
    return found.condition


async def test_a_node_on_loopback_is_not_granted_to_another_machine(talker: Talker) -> None:
    found = await talker.find("10.88.0.1")
    assert condition(found) is Condition.LISTENING
    assert "loopback only: start it without ROS_IP" in str(found)


async def test_a_node_at_every_address_is_granted_to_all() -> None:
    made = Talker("0.0.0.0")
    await made.node.start()
    made.node.uri = made.node.uri.replace("0.0.0.0", "127.0.0.1")
    assert await made.find("10.88.0.1") == Grant(made.port, "/talker", "")
    await made.ports.close()
    await made.node.close()


async def test_several_questions_at_a_time_become_one_and_the_answer_is_known_for_a_while(talker: Talker) -> None:
    found = await asyncio.gather(*(talker.find() for _ in range(20)))
    assert found == [Grant(talker.port, "/talker", "")] * 20
    assert talker.asked == ["/rmpa"]
    await talker.find()
    assert len(talker.asked) == 1
    talker.ports.forget(talker.node.uri)
    await talker.find()
    assert len(talker.asked) == 2


@pytest.mark.parametrize(
    "answer",
    [
        RosReply(0, "not now", []),
        RosReply(1, "", []),
        RosReply(1, "", ["TCPROS", "127.0.0.1"]),
        RosReply(1, "", ["UDPROS", "127.0.0.1", 45225]),
        RosReply(1, "", ["TCPROS", "127.0.0.1", 0]),
        RosReply(1, "", ["TCPROS", "127.0.0.1", 65536]),
        RosReply(1, "", ["TCPROS", "127.0.0.1", "45225"]),
        RosReply(1, "", ["TCPROS", "127.0.0.1", True]),
        RosReply(1, "x" * 10_000, "TCPROS"),
    ],
)
async def test_a_node_that_answers_with_something_else_is_named(talker: Talker, answer: RosReply) -> None:
    talker.answer = answer
    found = await talker.find()
    assert condition(found) is Condition.NODE
    assert len(str(found)) < 500


async def test_a_port_at_which_nothing_listens_any_more_is_not_granted(talker: Talker) -> None:
    talker.answer = RosReply(1, "", ["TCPROS", "127.0.0.1", 1])
    assert condition(await talker.find()) is Condition.LISTENING


async def test_a_dead_node_is_a_passing_reason(talker: Talker) -> None:
    uri = talker.node.uri
    await talker.node.close()
    found = await talker.ports.find("/talker", uri, "/t")
    assert isinstance(found, Unmet)
    assert (found.condition, found.lasting) == (Condition.NODE, False)


async def test_the_answers_of_many_nodes_are_remembered_within_a_bound(
    talker: Talker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "DIRECT_MAX", 3)
    for number in range(20):
        # The same node by other texts of its URI.
        await talker.ports.find("/talker", talker.node.uri + "x" * number, "/t")
    assert len(talker.ports._ports) <= 3


@pytest.mark.parametrize(
    ("uri", "wanted"),
    [
        ("rosrpc://127.0.0.1:{port}", None),
        ("rosrpc://127.0.0.1:{port}/", None),
        ("rosrpc://127.0.0.1:1", Condition.LISTENING),
        ("rosrpc://127.0.0.1:0", Condition.NODE),
        ("rosrpc://127.0.0.1:65536", Condition.NODE),
        ("rosrpc://127.0.0.1:²", Condition.NODE),
        ("rosrpc://127.0.0.1:" + "9" * 5000, Condition.NODE),
        ("http://127.0.0.1:{port}", Condition.NODE),
        ("", Condition.NODE),
    ],
)
async def test_the_port_of_a_service_is_that_of_its_uri(talker: Talker, uri: str, wanted: Condition | None) -> None:
    offered = {"/talker/add": SimpleNamespace(uri=uri.format(port=talker.port))}
    rpc = SimpleNamespace(on_request=lambda *_: None, on_notification=lambda *_: None)
    shared, exports = SimpleNamespace(rpc=rpc), SimpleNamespace(offered=offered)
    grants = ServiceGrants(cast("Any", shared), cast("Any", exports), lambda *_: None)
    found = await grants._find(seen_at("127.0.0.1"), Want("/talker/add", "/talker"))
    if wanted is None:
        assert found == Grant(talker.port, "/talker", "/talker/add")
    else:
        assert condition(found) is wanted
