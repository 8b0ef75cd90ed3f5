from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.ros.wire.slave_api import METHODS, BusConnection, SlaveApi

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rmpa.ros.wire.xmlrpc import XmlRpcValue


class Node:
    def __init__(self) -> None:
        self.calls: list[tuple[object, ...]] = []

    def publications(self) -> list[tuple[str, str]]:
        return [("/t", "std_msgs/String"), ("/quiet", "*")]

    def subscriptions(self) -> list[tuple[str, str]]:
        return [("/in", "std_msgs/Empty")]

    def connections(self) -> list[BusConnection]:
        return [
            BusConnection(1, "/listener", "o", "/t", True, "port 1", 3_000_000_000, 7),
            BusConnection(2, "/echo", "o", "/t", False, "port 2", 10, 0),
            BusConnection(3, "http://10.0.0.1:1/", "i", "/in", True, "port 3", 20, 5),
        ]

    def address_of(self, topic: str) -> tuple[str, int] | None:
        return ("127.0.0.1", 4000) if topic == "/t" else None

    def publisher_update(self, topic: str, publishers: Sequence[str]) -> None:
        self.calls.append(("publishers", topic, publishers))

    def param_update(self, key: str, value: XmlRpcValue) -> bool:
        self.calls.append(("param", key, value))
        return key == "/followed"

    def shut_down(self, reason: str) -> None:
        self.calls.append(("shutdown", reason))


@pytest.fixture
def node() -> Node:
    return Node()


@pytest.fixture
def api(node: Node) -> SlaveApi:
    made = SlaveApi("/n", "http://localhost:11311", 42, node)
    made.uri = "http://127.0.0.1:5000/"
    return made


@pytest.mark.trap(21, 22)
@pytest.mark.parametrize(
    ("method", "params", "reply"),
    [
        ("getPid", ["/c"], (1, "", 42)),
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
def test_answers(api: SlaveApi, method: str, params: list[XmlRpcValue], reply: tuple[XmlRpcValue, ...]) -> None:
    assert tuple(api.dispatch(method, params)) == reply


def test_without_a_master_its_uri_is_a_failure(node: Node) -> None:
    assert SlaveApi("/n", "", 42, node).dispatch("getMasterUri", ["/c"]) == (0, "master URI not set", "")


@pytest.mark.trap(29)
def test_bus_info_is_in_rospys_form(api: SlaveApi) -> None:
    assert api.dispatch("getBusInfo", ["/c"]).value == [
        [1, "/listener", "o", "TCPROS", "/t", True, "port 1"],
        [2, "/echo", "o", "TCPROS", "/t", False, "port 2"],
        [3, "http://10.0.0.1:1/", "i", "TCPROS", "/in", True, "port 3"],
    ]


def test_bus_stats_fit_into_31_bits(api: SlaveApi) -> None:
    assert api.dispatch("getBusStats", ["/c"]).value == [
        [["/t", 2147483647, [[1, 2147483647, 7, True], [2, 10, 0, False]]], ["/quiet", 0, []]],
        [["/in", [[3, 20, 5, -1, True]]]],
        [],
    ]


def test_publisher_updates_reach_the_node(api: SlaveApi, node: Node) -> None:
    assert api.dispatch("publisherUpdate", ["/master", "/in", ["http://x:1/"]]) == (1, "", 0)
    assert api.dispatch("publisherUpdate", ["/master", "/in", []]) == (1, "", 0)
    assert node.calls == [("publishers", "/in", ["http://x:1/"]), ("publishers", "/in", [])]


@pytest.mark.trap(34)
def test_param_updates_lose_the_slash_at_their_end(api: SlaveApi, node: Node) -> None:
    assert api.dispatch("paramUpdate", ["/master", "/followed/", {}]) == (1, "", 0)
    assert api.dispatch("paramUpdate", ["/master", "/other", 1]) == (-1, "not subscribed", 0)
    assert api.dispatch("paramUpdate", ["/master", "/", 1]).code == -1
    assert [call[1] for call in node.calls] == ["/followed", "/other", "/"]


@pytest.mark.trap(29)
def test_the_reason_of_a_shutdown_may_be_missing(api: SlaveApi, node: Node) -> None:
    assert api.dispatch("shutdown", ["/master", "replaced"]) == (1, "shutdown", 0)
    assert api.dispatch("shutdown", ["/master"]) == (1, "shutdown", 0)
    assert node.calls == [("shutdown", "replaced"), ("shutdown", "")]


@pytest.mark.parametrize("method", METHODS)
def test_every_method_survives_nonsense(api: SlaveApi, method: str) -> None:
    nonsense: list[XmlRpcValue] = [None, [], {}, "", "/", 3, [[]], [[1]], b"\xff", "http://x"]
    for first in nonsense:
        for second in nonsense:
            for params in ([first], ["/c", first], ["/c", first, second], ["/c", first, second, 1]):
                code, status, _ = api.dispatch(method, params)
                assert code in (-1, 0, 1)
                assert isinstance(status, str)


def test_an_unknown_method_is_a_key_error(api: SlaveApi) -> None:
    with pytest.raises(KeyError):
        api.dispatch("getNothing", ["/c"])
