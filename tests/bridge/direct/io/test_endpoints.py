"""Where a local node may be reached by a peer: asked of real slave nodes, and of the kernel."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from rmpa.bridge import limits
from rmpa.bridge.direct.nodes import Condition, Grant, LocalEndpoints, Unmet
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.wire.xmlrpc import RosReply
from tests.ros.node.peers import STRING

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable


class Talker(PublicationEvents):
    """A node that publishes /t, and the endpoints of its module."""

    def __init__(self, host: str = "127.0.0.1") -> None:
        self.node = SlaveNode("/talker", host, "")
        self.asked: list[str] = []
        self.answer: RosReply | None = None
        self.node.add_publication(Publication("/t", "/talker", STRING, events=self))
        self.services: dict[str, dict[str, str]] = {}
        core = SimpleNamespace(state=lambda: SimpleNamespace(services=self.services))
        self.endpoints = LocalEndpoints(cast("Any", core))

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
        session = cast("Any", SimpleNamespace(own_address=own_address))
        return await self.endpoints.of_topic(session, "/talker", self.node.uri, "/t")


@pytest.fixture
async def talker() -> AsyncIterator[Talker]:
    made = Talker()
    await made.node.start()
    yield made
    await made.endpoints.close()
    await made.node.close()


def condition(found: Grant | Unmet) -> Condition:
    assert isinstance(found, Unmet), found
    return found.condition


async def test_a_node_on_the_same_machine_is_granted_with_the_service_to_probe_it_by(talker: Talker) -> None:
    assert await talker.find() == Grant(talker.port, "/talker", "")
    talker.services["/talker/get_loggers"] = {"/talker": "rosrpc://127.0.0.1:1"}
    assert await talker.find() == Grant(talker.port, "/talker", "/talker/get_loggers")
    talker.services["/talker/get_loggers"] = {"/other": "rosrpc://127.0.0.1:1"}
    assert await talker.find() == Grant(talker.port, "/talker", ""), "of another node"


async def test_a_node_on_loopback_is_not_granted_to_another_machine(talker: Talker) -> None:
    found = await talker.find("10.88.0.1")
    assert condition(found) is Condition.LISTENING
    assert "loopback only: start it without ROS_IP" in str(found)


async def test_a_node_at_every_address_is_granted_to_all() -> None:
    made = Talker("0.0.0.0")
    await made.node.start()
    made.node.uri = made.node.uri.replace("0.0.0.0", "127.0.0.1")
    assert await made.find("10.88.0.1") == Grant(made.port, "/talker", "")
    await made.endpoints.close()
    await made.node.close()


async def test_several_questions_at_a_time_become_one_and_the_answer_is_known_for_a_while(talker: Talker) -> None:
    found = await asyncio.gather(*(talker.find() for _ in range(20)))
    assert found == [Grant(talker.port, "/talker", "")] * 20
    assert talker.asked == ["/rmpa"]
    await talker.find()
    assert len(talker.asked) == 1
    talker.endpoints.forget(talker.node.uri)
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
    session = cast("Any", SimpleNamespace(own_address="127.0.0.1"))
    found = await talker.endpoints.of_topic(session, "/talker", uri, "/t")
    assert condition(found) is Condition.NODE
    assert isinstance(found, Unmet)
    assert not found.lasting


async def test_the_answers_of_many_nodes_are_remembered_within_a_bound(
    talker: Talker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "DIRECT_MAX", 3)
    uri, session = talker.node.uri, cast("Any", SimpleNamespace(own_address="127.0.0.1"))
    for number in range(20):
        # The same node by other texts of its URI.
        await talker.endpoints.of_topic(session, "/talker", uri + "x" * number, "/t")
    assert len(talker.endpoints._ports) <= 3


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
    session = cast("Any", SimpleNamespace(own_address="127.0.0.1"))
    found = talker.endpoints.of_service(session, "/talker", uri.format(port=talker.port), "/talker/add")
    if wanted is None:
        assert found == Grant(talker.port, "/talker", "/talker/add")
    else:
        assert condition(found) is wanted
