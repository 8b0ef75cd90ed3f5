"""A node's slave API."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Awaitable, Callable

import pytest

from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.node.slave_node import SlaveNode, Subscription
from rmpa.ros.wire.slave_api import METHODS, BusConnection
from rmpa.ros.wire.tcpros import TopicDescription
from rmpa.ros.wire.xmlrpc import RosFault, RosReply, XmlRpcValue
from tests.ros.node.peers import STRING
from tests.waiting import until


@pytest.fixture
async def node() -> AsyncIterator[SlaveNode]:
    made = SlaveNode("/p", "127.0.0.1", "http://127.0.0.1:11311/")
    await made.start()
    yield made
    await made.close()


class Asked(PublicationEvents):
    """Lets a function answer ``requestTopic``."""

    def __init__(self, answer: Callable[[str], Awaitable[RosReply | None] | None]) -> None:
        self.answer = answer

    def request(self, caller: str) -> Awaitable[RosReply | None] | None:
        return self.answer(caller)


@pytest.mark.parametrize("other", [RosReply(1, "there", ["TCPROS", "10.0.0.1", 45225]), RosReply(0, "no", []), None])
@pytest.mark.trap(42)
async def test_the_answer_to_request_topic_may_take_its_time(node: SlaveNode, other: RosReply | None) -> None:
    asked: list[str] = []
    known = asyncio.Event()

    async def decide() -> RosReply | None:
        await known.wait()
        return other

    def request(caller: str) -> Awaitable[RosReply | None] | None:
        asked.append(caller)
        return None if caller == "/plain" else decide()

    node.add_publication(Publication("/t", "/p", STRING, events=Asked(request)))
    own = await call_api(node.uri, "requestTopic", "/plain", "/t", [["TCPROS"]])
    waiting = asyncio.create_task(call_api(node.uri, "requestTopic", "/viewer", "/t", [["TCPROS"]]))
    await until(lambda: "/viewer" in asked)
    # Meanwhile the node answers others.
    assert await call_api(node.uri, "requestTopic", "/plain", "/t", [["TCPROS"]]) == own
    known.set()
    assert await waiting == (own if other is None else other)
    # Topics that it does not have are not asked about.
    assert (await call_api(node.uri, "requestTopic", "/viewer", "/none", [["TCPROS"]])).code != 1
    assert asked == ["/plain", "/viewer", "/plain"]


class Node(SlaveNode):
    def __init__(self, master_uri: str = "http://localhost:11311") -> None:
        self.calls: list[tuple[object, ...]] = []

        def follow(key: str, value: XmlRpcValue) -> bool:
            self.calls.append(("param", key, value))
            return key == "/followed"

        def shut_down(reason: str) -> None:
            self.calls.append(("shutdown", reason))

        super().__init__("/n", "127.0.0.1", master_uri, on_shutdown=shut_down, on_param_update=follow)
        self.uri = "http://127.0.0.1:5000/"
        self._tcpros_port = 4000
        self.add_publication(Publication("/t", "/n", TopicDescription("std_msgs/String", "5", "")))
        self.add_publication(Publication("/quiet", "/n"))
        empty = TopicDescription("std_msgs/Empty", "*", "")
        self.add_subscription(Subscription("/in", self, on_message=lambda *_: None, wanted=empty))

    def connections(self) -> list[BusConnection]:
        return [
            BusConnection(1, "/listener", "o", "/t", True, "port 1", 3_000_000_000, 7),
            BusConnection(2, "/echo", "o", "/t", False, "port 2", 10, 0),
            BusConnection(3, "http://10.0.0.1:1/", "i", "/in", True, "port 3", 20, 5),
        ]

    def ask(self, method: str, *params: XmlRpcValue) -> list[XmlRpcValue]:
        answer = self._call(method, params)
        assert isinstance(answer, list)
        return answer


@pytest.fixture
def api_node() -> Node:
    return Node()


@pytest.mark.trap(21, 22)
@pytest.mark.parametrize(
    ("method", "params", "reply"),
    [
        ("getPid", ["/c"], (1, "", os.getpid())),
        ("getName", ["/c"], (1, "", "/n")),
        ("getUri", ["/c"], (1, "", "http://127.0.0.1:5000/")),
        ("getMasterUri", ["/c"], (1, "http://localhost:11311", "http://localhost:11311")),
        ("getPublications", ["/c"], (1, "publications", [["/t", "std_msgs/String"], ["/quiet", "*"]])),
        ("getSubscriptions", ["/c"], (1, "subscriptions", [["/in", "std_msgs/Empty"]])),
        ("requestTopic", ["/c", "/t", [["TCPROS"]]], (1, "ready on 127.0.0.1:4000", ["TCPROS", "127.0.0.1", 4000])),
        (
            "requestTopic",
            ["/c", "/t", [["UDPROS", b"header", "host", 1, 1500], ["TCPROS"]]],
            (1, "ready on 127.0.0.1:4000", ["TCPROS", "127.0.0.1", 4000]),
        ),
        ("requestTopic", ["/c", "/t", [["UDPROS"]]], (0, "no supported protocol implementations", [])),
        ("requestTopic", ["/c", "/other", [["TCPROS"]]], (-1, "Not a publisher of [/other]", [])),
        ("requestTopic", ["/c", "/t", []], (-1, "ERROR: parameter [protocols] must be specified and non-empty", [])),
        ("requestTopic", ["/c", "/t", "TCPROS"], (-1, "protocols must be a list", [])),
        ("requestTopic", ["/c", "", [["TCPROS"]]], (-1, "topic name must be a non-empty string", [])),
        ("requestTopic", ["/c", "/a b", [["TCPROS"]]], (-1, "topic name [/a b] contains illegal chars", [])),
        ("requestTopic", ["/c", "/t"], (-1, "Error: bad call arity", [])),
        ("requestTopic", [], (-1, "missing required caller_id parameter", [])),
        ("requestTopic", [1, "/t", [["TCPROS"]]], (-1, "caller_id must be a string", [])),
        ("publisherUpdate", ["/c", "/in", "http://x:1/"], (-1, "publishers must be a list", -1)),
        ("publisherUpdate", ["/c", "/in", ["x"]], (-1, "publishers must be a list of URIs", -1)),
        ("paramUpdate", ["/c", "relative", 1], (-1, "parameter_key must be a global name", -1)),
    ],
)
def test_answers(api_node: Node, method: str, params: list[XmlRpcValue], reply: tuple[XmlRpcValue, ...]) -> None:
    assert tuple(api_node.ask(method, *params)) == reply


@pytest.mark.trap(29)
def test_bus_info_is_in_rospys_form(api_node: Node) -> None:
    assert api_node.ask("getBusInfo", "/c")[2] == [
        [1, "/listener", "o", "TCPROS", "/t", True, "port 1"],
        [2, "/echo", "o", "TCPROS", "/t", False, "port 2"],
        [3, "http://10.0.0.1:1/", "i", "TCPROS", "/in", True, "port 3"],
    ]


@pytest.mark.trap(34)
def test_param_updates_lose_the_slash_at_their_end(api_node: Node) -> None:
    assert api_node.ask("paramUpdate", "/master", "/followed/", {}) == [1, "", 0]
    assert api_node.ask("paramUpdate", "/master", "/other", 1) == [-1, "not subscribed", 0]
    assert api_node.ask("paramUpdate", "/master", "/", 1)[0] == -1
    assert [call[1] for call in api_node.calls] == ["/followed", "/other", "/"]


@pytest.mark.trap(29)
def test_the_reason_of_a_shutdown_may_be_missing(api_node: Node) -> None:
    assert api_node.ask("shutdown", "/master", "replaced") == [1, "shutdown", 0]
    assert api_node.ask("shutdown", "/master") == [1, "shutdown", 0]
    assert api_node.calls == [("shutdown", "replaced"), ("shutdown", "")]


@pytest.mark.parametrize("method", METHODS)
def test_every_method_survives_nonsense(api_node: Node, method: str) -> None:
    nonsense: list[XmlRpcValue] = [None, [], {}, "", "/", 3, [[]], [[1]], b"\xff", "http://x"]
    for first in nonsense:
        for second in nonsense:
            for params in ([first], ["/c", first], ["/c", first, second], ["/c", first, second, 1]):
                code, status, _ = api_node.ask(method, *params)
                assert code in (-1, 0, 1)
                assert isinstance(status, str)


def test_an_unknown_method_is_a_fault(api_node: Node) -> None:
    with pytest.raises(RosFault, match="/n has no method getNothing"):
        api_node.ask("getNothing", "/c")
