"""The graph of ROS 2 from tokens: what is there, what is ignored, and its bounds."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.gateway import limits
from rmpa.gateway.ros2.format import EntityKind, Ros2Endpoint, Ros2Node, Ros2Qos
from rmpa.gateway.ros2.graph import Ros2Graph, valid_name

if TYPE_CHECKING:
    import pytest

HASH = "RIHS01_" + "0" * 64


def publisher(number: int = 1, node: str = "/bot", name: str = "/chatter", zid: str = "ab", domain: int = 0) -> str:
    made = Ros2Node(domain, zid, 0, node)
    return Ros2Endpoint(made, number, EntityKind.PUBLISHER, name, "std_msgs/msg/String", HASH, Ros2Qos()).token()


def test_what_appears_is_there_until_it_disappears() -> None:
    graph = Ros2Graph(0, "cd")
    node, endpoint = Ros2Node(0, "ab", 0, "/bot"), publisher()
    assert graph.change(node.token(), alive=True) == node
    made = graph.change(endpoint, alive=True)
    assert isinstance(made, Ros2Endpoint)
    assert graph.change(endpoint, alive=True) is None, "a token that is told twice is one"
    assert list(graph.at("/chatter", EntityKind.PUBLISHER)) == [made]
    assert list(graph.at("/chatter", EntityKind.SUBSCRIPTION)) == []
    assert (graph.nodes, len(graph)) == ({"/bot"}, 1)
    assert graph.change(endpoint, alive=False) == made
    assert graph.change(endpoint, alive=False) is None
    assert graph.change(node.token(), alive=False) == node
    assert (graph.nodes, len(graph), list(graph.at("/chatter", *EntityKind))) == (set(), 0, [])


def test_what_is_not_of_this_graph_is_ignored_and_counted() -> None:
    graph = Ros2Graph(0, "cd")
    for key, reason in (
        (publisher(domain=7), "other domain"),
        (publisher(node="/rmpa/arm/talker"), "other gateway"),
        (publisher(node="/rmpa/host_gateway"), "other gateway"),
        (publisher(name="/a b"), "impossible name"),
        (publisher(node="/a//b"), "impossible name"),
        (publisher()[:-20], "malformed"),
    ):
        before = graph.ignored[reason]
        assert graph.change(key, alive=True) is None
        assert graph.ignored[reason] == before + 1, key
        assert graph.change(key, alive=False) is None
    assert graph.change(publisher(zid="cd"), alive=True) is None
    assert graph.ignored.total() == 6, "this gateway's own tokens are nothing to tell of"
    assert graph.change(publisher(node="/rmpad/talker"), alive=True) is not None


def test_tokens_above_the_bounds_are_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "ROS2_ENDPOINTS_MAX", 3)
    monkeypatch.setattr(limits, "ROS2_NODES_MAX", 2)
    graph = Ros2Graph(0, "cd")
    for number in range(5):
        graph.change(publisher(number), alive=True)
        graph.change(Ros2Node(0, "ab", number, f"/bot{number}").token(), alive=True)
    assert (len(graph), len(graph.nodes)) == (3, 2)
    assert graph.ignored == {"too many endpoints": 2, "too many nodes": 3}
    graph.change(publisher(0), alive=False)
    assert graph.change(publisher(9), alive=True) is not None


def test_names_that_ros2_does_not_allow_are_told_apart() -> None:
    assert valid_name("/a/b_1")
    for name in ("/1a", "/a/2", "a", "/", "/a/", "/a b", "/" + "x" * 300):
        assert not valid_name(name), name
