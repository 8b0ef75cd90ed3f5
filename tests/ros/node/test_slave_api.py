from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from rmpa.ros.node.publication import Publication
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.node.subscription import Subscription
from rmpa.ros.wire.slave_api import METHODS, BusConnection
from rmpa.ros.wire.tcpros import TopicDescription
from rmpa.ros.wire.xmlrpc import RosFault

if TYPE_CHECKING:
    from rmpa.ros.wire.xmlrpc import XmlRpcValue


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
        self._tcpros.address = ("127.0.0.1", 4000)
        self.add_publication(Publication("/t", "/n", TopicDescription("std_msgs/String", "5", "")))
        self.add_publication(Publication("/quiet", "/n"))
        self.add_subscription(Subscription("/in", "/n", on_message=lambda *_: None, type_name="std_msgs/Empty"))

    def connections(self) -> list[BusConnection]:
        return [
            BusConnection(1, "/listener", "o", "/t", True, "port 1", 3_000_000_000, 7),
            BusConnection(2, "/echo", "o", "/t", False, "port 2", 10, 0),
            BusConnection(3, "http://10.0.0.1:1/", "i", "/in", True, "port 3", 20, 5),
        ]

    def ask(self, method: str, *params: XmlRpcValue) -> list[XmlRpcValue]:
        answer = self._call(method, params, "127.0.0.1")
        assert isinstance(answer, list)
        return answer


@pytest.fixture
def node() -> Node:
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
def test_answers(node: Node, method: str, params: list[XmlRpcValue], reply: tuple[XmlRpcValue, ...]) -> None:
    assert tuple(node.ask(method, *params)) == reply


def test_without_a_master_its_uri_is_a_failure() -> None:
    assert Node("").ask("getMasterUri", "/c") == [0, "master URI not set", ""]


@pytest.mark.trap(29)
def test_bus_info_is_in_rospys_form(node: Node) -> None:
    assert node.ask("getBusInfo", "/c")[2] == [
        [1, "/listener", "o", "TCPROS", "/t", True, "port 1"],
        [2, "/echo", "o", "TCPROS", "/t", False, "port 2"],
        [3, "http://10.0.0.1:1/", "i", "TCPROS", "/in", True, "port 3"],
    ]


def test_bus_stats_fit_into_31_bits(node: Node) -> None:
    assert node.ask("getBusStats", "/c")[2] == [
        [["/t", 2147483647, [[1, 2147483647, 7, True], [2, 10, 0, False]]], ["/quiet", 0, []]],
        [["/in", [[3, 20, 5, -1, True]]]],
        [],
    ]


@pytest.mark.trap(34)
def test_param_updates_lose_the_slash_at_their_end(node: Node) -> None:
    assert node.ask("paramUpdate", "/master", "/followed/", {}) == [1, "", 0]
    assert node.ask("paramUpdate", "/master", "/other", 1) == [-1, "not subscribed", 0]
    assert node.ask("paramUpdate", "/master", "/", 1)[0] == -1
    assert [call[1] for call in node.calls] == ["/followed", "/other", "/"]


@pytest.mark.trap(29)
def test_the_reason_of_a_shutdown_may_be_missing(node: Node) -> None:
    assert node.ask("shutdown", "/master", "replaced") == [1, "shutdown", 0]
    assert node.ask("shutdown", "/master") == [1, "shutdown", 0]
    assert node.calls == [("shutdown", "replaced"), ("shutdown", "")]


@pytest.mark.parametrize("method", METHODS)
def test_every_method_survives_nonsense(node: Node, method: str) -> None:
    nonsense: list[XmlRpcValue] = [None, [], {}, "", "/", 3, [[]], [[1]], b"\xff", "http://x"]
    for first in nonsense:
        for second in nonsense:
            for params in ([first], ["/c", first], ["/c", first, second], ["/c", first, second, 1]):
                code, status, _ = node.ask(method, *params)
                assert code in (-1, 0, 1)
                assert isinstance(status, str)


def test_an_unknown_method_is_a_fault(node: Node) -> None:
    with pytest.raises(RosFault, match="/n has no method getNothing"):
        node.ask("getNothing", "/c")
