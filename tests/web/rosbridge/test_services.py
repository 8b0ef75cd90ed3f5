"""Calls of a client, services that it offers, and rosapi, through its session."""

from __future__ import annotations

import json
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

from rmpa.core.errors import RmpaError
from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType
from rmpa.web.rosbridge import limits
from rmpa.web.rosbridge.protocol import decode_png
from rmpa.web.rosbridge.rosapi import SERVICES
from tests.web.recorder import NOW_NS, Asked
from tests.web.rosbridge.client import Client

ADD = "rospy_tutorials/AddTwoInts"
TWENTY_AND_TWO = b"\x14" + bytes(7) + b"\x02" + bytes(7)
TWENTY_TWO = b"\x16" + bytes(7)


# --- calls -------------------------------------------------------------------------------------------------------


@pytest.fixture
def client(client: Client) -> Client:
    client.graph.add_service("/add", ADD)
    return client


def _call(client: Client, args: Any = (1, 1), service: str = "/add", **values: Any) -> Asked:
    return client.one("call", client.send("call_service", id="c", service=service, args=args, **values))


@pytest.mark.parametrize("args", [{"a": 20, "b": 2}, [20, 2]])
def test_a_call_and_its_answer(client: Client, args: Any) -> None:
    call = _call(client, args, "add", timeout=3)
    assert (call.service, call.type, call.request, call.timeout) == ("/add", ADD, TWENTY_AND_TWO, 3)
    call.done(TWENTY_TWO)
    ((_, parts),) = client.frames()
    assert parts == (b'{"op":"service_response","service":"add","values":{"sum":22},"result":true,"id":"c"}',)


def test_the_answer_comes_in_the_compression_and_fragments_that_were_asked_for(client: Client) -> None:
    for compression in ("png", "cbor", "none"):
        _call(client, compression=compression, fragment_size=4000).done(TWENTY_TWO)
    png, cbor, none = client.received()
    want = {"op": "service_response", "service": "/add", "id": "c", "values": {"sum": 22}, "result": True}
    assert json.loads(decode_png(png["data"])) == cbor == none == want
    _call(client, fragment_size=10).done(TWENTY_TWO)
    fragments = client.received()
    assert {each["id"] for each in fragments} == {"c"}
    assert json.loads("".join(each["data"] for each in fragments)) == want


def test_an_old_client_gives_its_id_with_the_name(client: Client) -> None:
    client.one("call", client.send("call_service", service="/add#7", args=[1, 1])).done(TWENTY_TWO)
    assert client.received()[0]["id"] == "7"


def test_a_service_of_unknown_type_is_looked_up_first(client: Client) -> None:
    find = client.one("find_service", client.send("call_service", id="c", service="/sum", args=[20, 2]))
    assert find.service == "/sum"
    find.done(ADD)
    call = client.last("call")
    assert call.request == TWENTY_AND_TWO
    call.done(TWENTY_TWO)
    assert client.received()[0]["values"] == {"sum": 22}


@pytest.mark.parametrize(
    ("op", "says"),
    [
        ({"service": "/add", "args": {"c": 1}}, "has no field 'c'"),
        ({"service": "/add", "args": [1, 2, 3]}, "has 2 fields, not 3"),
        ({"service": "/add", "args": 5}, "an object or a list"),
        ({"service": "/add", "args": [2**63, 1]}, "does not fit int64"),
        ({"service": "/x", "type": "no/Such", "args": []}, "no/Such"),
        ({"service": "a b", "args": []}, "not a ROS name"),
        ({"service": "/add", "args": [], "compression": "zip"}, "zip"),
        ({"service": "/add", "args": [], "timeout": -1}, "more than 0 s"),
        ({"service": "/rosapi/topic_type", "args": {"topic": "a b"}}, "not a ROS name"),
        ({"service": "/rosapi/message_details", "args": {"type": "no/Such"}}, "no/Such"),
        ({"service": "/rosapi/set_param", "args": {"name": "/a", "value": "text"}}, "is JSON, in a string"),
        ({"service": "/rosapi/set_param", "args": {"name": "/a", "value": "[" * 100 + "]" * 100}}, "nested deeper"),
        ({"service": "/rosapi/set_param", "args": {"name": "/a", "value": "[" * 100_000}}, "nested too deep"),
    ],
)
def test_a_call_that_cannot_be_made_has_an_answer_and_nothing_beside_it(
    client: Client, op: dict[str, Any], says: str
) -> None:
    assert not client.send("call_service", id="c", **op)
    (answer,) = client.received()
    assert (answer["op"], answer["result"], answer["id"]) == ("service_response", False, "c")
    assert says in answer["values"]


def test_a_call_that_fails_says_why(client: Client) -> None:
    _call(client).failed(RmpaError("the server raised"))
    (response,) = client.received()
    assert (response["result"], response["values"]) == (False, "the server raised")
    _call(client).done(b"short")
    (response,) = client.received()
    assert not response["result"]
    assert "5 bytes are not" in response["values"]


def test_open_calls_are_bounded(client: Client) -> None:
    for _ in range(limits.CALLS_MAX + 2):
        client.send("call_service", service="/add", args=[1, 1])
    assert [each["result"] for each in client.received()] == [False, False]
    client.last("call").done(TWENTY_TWO)
    client.received()
    client.send("call_service", service="/add", args=[1, 1])
    assert not client.received()


# --- services of the client --------------------------------------------------------------------------------------


def _serve(client: Client) -> Asked:
    return client.one("serve", client.send("advertise_service", service="/add", type=ADD))


def _ask(serve: Asked, request: bytes = TWENTY_AND_TWO) -> Future[bytes]:
    """A call of a node; the response in a future of another kind than asyncio's, which needs no loop."""
    response: Future[bytes] = Future()
    serve.called(request, response)
    return response


def test_a_client_serves(client: Client) -> None:
    serve = _serve(client)
    assert (serve.service, serve.type) == ("/add", ADD)
    response = _ask(serve)
    (call,) = client.received()
    assert call == {
        "op": "call_service",
        "id": "service_request:/add:1",
        "service": "/add",
        "args": {"a": 20, "b": 2},
    }
    answer = {"id": call["id"], "service": "/add", "values": {"sum": 22}, "result": True}
    client.send("service_response", **answer)
    assert response.result() == TWENTY_TWO
    client.send("service_response", **answer)
    assert "no open call" in client.error()
    client.send("unadvertise_service", service="/add")
    assert (serve.closed, serve.reason) == (True, "the service was unadvertised")


def test_a_clients_service_may_fail_or_answer_wrongly(client: Client) -> None:
    serve = _serve(client)
    for op, says in (
        ({"result": False, "values": "no luck"}, "no luck"),
        ({"result": False}, "the service failed"),
        ({"result": True, "values": {"sum": "x"}}, "sum: is a int64, not 'x'"),
    ):
        response = _ask(serve)
        (call,) = client.received()
        client.send("service_response", id=call["id"], service="/add", **op)
        assert says in str(response.exception())
        client.received()
    assert "not a" in str(_ask(serve, b"short").exception())


def test_a_service_is_offered_anew_and_reported_where_the_hub_cannot(client: Client) -> None:
    first, second = _serve(client), _serve(client)
    assert (first.closed, first.reason) == (True, "the service is offered again")
    second.failed(RmpaError("the name is taken"))
    assert client.error() == "advertise_service /add: the name is taken"


def test_requests_to_a_client_that_does_not_answer_are_bounded(client: Client) -> None:
    serve = _serve(client)
    responses = [_ask(serve) for _ in range(limits.REQUESTS_MAX + 3)]
    assert sum(response.done() for response in responses) == 3
    responses[0].cancel()  # its caller has given up
    responses[0].set_running_or_notify_cancel()
    assert not _ask(serve).done()


# --- rosapi ------------------------------------------------------------------------------------------------------


@pytest.fixture
def robot(client: Client) -> Client:
    graph = client.graph
    graph.add_topic("/a/cancel", "actionlib_msgs/GoalID")
    graph.add_topic("/a/feedback", "actionlib/TestActionFeedback")
    graph.add_topic("/a/goal", "actionlib/TestActionGoal", subscribers=("/server",))
    graph.add_topic("/a/result", "actionlib/TestActionResult")
    graph.add_topic("/a/status", "actionlib_msgs/GoalStatusArray")
    for part, kind in (("status", "actionlib_msgs/GoalStatusArray"), ("result", "x/AResult"), ("feedback", "x/A")):
        graph.add_topic(f"/arm/dock/{part}", kind, publishers=("/rmpa/arm/docker",))  # of a peer
        graph.add_topic(f"/client/{part}", kind, subscribers=("/here",))
    graph.add_topic("/b/goal", "std_msgs/String", publishers=("/talker", "/other"), subscribers=("/listener",))
    graph.add_topic("/odd", "no_such/Type")
    graph.add_topic("/untyped", subscribers=("/listener",))
    graph.add_service("/add", ADD, "/server")
    graph.add_service("/unknown", "", "/talker", "rosrpc://[::1]:99")
    graph.nodes = ("/listener", "/other", "/server", "/talker")
    tree = {"rate": 10, "ns": {"deep": {"x": 1.5, "y": [1, "b"]}, "empty": {}}, "rosapi": {"mine": True}}
    client.hub.params.tree = tree
    return client


def _rosapi(client: Client, service: str, /, **args: Any) -> Any:
    assert not client.send("call_service", service=f"/rosapi/{service}", args=args)
    (answer,) = client.received()
    assert answer["result"], answer
    values = answer["values"]
    # What JSON clients get is also a valid ROS response.
    codec_for(ServiceType(SERVICES[f"/rosapi/{service}"]).response).write(values, 0)
    return values


def test_topics_with_the_texts_of_their_types(robot: Client) -> None:
    topics = _rosapi(robot, "topics")
    assert topics["topics"] == list(robot.graph.topics)
    assert dict(zip(topics["topics"], topics["types"], strict=True))["/untyped"] == ""
    raw = _rosapi(robot, "topics_and_raw_types")
    texts = dict(zip(raw["types"], raw["typedefs_full_text"], strict=True))
    assert texts["std_msgs/String"] == MessageType("std_msgs/String").definition
    assert texts["no_such/Type"] == texts[""] == ""


SECS, NSECS = divmod(NOW_NS, 10**9)
NAMES = ["/ns/deep/x", "/ns/deep/y", "/ns/empty", "/rate", "/rosapi/mine"]
NODES = ["/listener", "/other", "/server", "/talker"]


@pytest.mark.parametrize(
    ("service", "args", "values"),
    [
        ("topics_for_type", {"type": "std_msgs/String"}, {"topics": ["/b/goal"]}),
        ("topic_type", {"topic": "/b/goal"}, {"type": "std_msgs/String"}),
        ("topic_type", {"topic": "/none"}, {"type": ""}),
        ("publishers", {"topic": "/b/goal"}, {"publishers": ["/talker", "/other"]}),
        ("subscribers", {"topic": "/b/goal"}, {"subscribers": ["/listener"]}),
        ("subscribers", {"topic": "/none"}, {"subscribers": []}),
        ("action_servers", {}, {"action_servers": ["/a", "/arm/dock"]}),
        ("services", {}, {"services": ["/add", "/unknown"]}),
        ("service_type", {"service": "/add"}, {"type": ADD}),
        ("service_type", {"service": "/none"}, {"type": ""}),
        ("service_type", {"service": "/rosapi/topics"}, {"type": "rosapi/Topics"}),
        ("service_node", {"service": "/add"}, {"node": "/server"}),
        ("service_node", {"service": "/none"}, {"node": ""}),
        ("service_host", {"service": "/add"}, {"host": "robot"}),
        ("service_host", {"service": "/unknown"}, {"host": "::1"}),
        ("service_host", {"service": "/none"}, {"host": ""}),
        ("service_providers", {"service": "/add"}, {"providers": ["/server"]}),
        ("nodes", {}, {"nodes": NODES}),
        (
            "node_details",
            {"node": "/listener"},
            {"subscribing": ["/b/goal", "/untyped"], "publishing": [], "services": []},
        ),
        ("node_details", {"node": "/server"}, {"subscribing": ["/a/goal"], "publishing": [], "services": ["/add"]}),
        ("get_time", {}, {"time": {"secs": SECS, "nsecs": NSECS}}),
        ("get_param", {"name": "/ns/deep"}, {"value": '{"x": 1.5, "y": [1, "b"]}'}),
        ("get_param", {"name": "rate", "default": "5"}, {"value": "10"}),
        ("get_param", {"name": "/none", "default": "5"}, {"value": "5"}),
        ("get_param", {"name": "/none", "default": "text"}, {"value": '"text"'}),
        ("get_param", {"name": "/none"}, {"value": "null"}),
        ("has_param", {"name": "/ns/deep/x"}, {"exists": True}),
        ("has_param", {"name": "/rate/x"}, {"exists": False}),
        ("get_param_names", {}, {"names": NAMES}),
        ("search_param", {"name": "rate"}, {"global_name": "/rate"}),
        ("search_param", {"name": "mine"}, {"global_name": "/rosapi/mine"}),
        ("search_param", {"name": "none"}, {"global_name": ""}),
        ("search_param", {"name": "/ns/deep"}, {"global_name": "/ns/deep"}),
        ("delete_param", {"name": "/none"}, {}),
    ],
)
def test_the_graph_and_the_parameters_answer(
    robot: Client, service: str, args: dict[str, str], values: dict[str, Any]
) -> None:
    assert _rosapi(robot, service, **args) == values


@pytest.mark.parametrize(
    ("service", "args", "values"),
    [
        ("services_for_type", {"type": ADD}, {"services": ["/add", "/late"]}),
        ("service_providers", {"service": ADD}, {"providers": ["/server", "/slow"]}),
    ],
)
def test_servers_that_did_not_tell_their_type_are_asked_before_services_are_listed_by_type(
    robot: Client, service: str, args: dict[str, str], values: dict[str, list[str]]
) -> None:
    robot.graph.add_service("/late", "", "/slow")
    robot.graph.found["/late"] = ADD
    assert _rosapi(robot, service, **args) == values


def test_the_type_of_a_service_that_the_graph_does_not_know_is_looked_up(robot: Client) -> None:
    assert _rosapi(robot, "service_type", service="/unknown") == {"type": ""}
    robot.graph.found["/unknown"] = ADD
    assert _rosapi(robot, "service_type", service="/unknown") == {"type": ADD}


def test_parameters_are_set_and_deleted_by_the_hub(robot: Client) -> None:
    def ask(what: str, **args: str) -> Asked:
        return robot.one(what, robot.send("call_service", id="s", service=f"/rosapi/{what}", args=args))

    request = ask("set_param", name="/new", value='{"a": [1, 2.5]}')
    assert (request.name, request.value) == ("/new", {"a": [1, 2.5]})
    assert not robot.received()
    request.done(None)
    (answer,) = robot.received()
    assert (answer["id"], answer["result"], answer["values"]) == ("s", True, {})
    ask("delete_param", name="/rate").failed(RmpaError("read-only"))
    assert robot.received()[0]["result"] is False


def test_details_of_types(robot: Client) -> None:
    first, *others = _rosapi(robot, "message_details", type="geometry_msgs/PoseStamped")["typedefs"]
    assert first == {
        "type": "geometry_msgs/PoseStamped",
        "fieldnames": ["header", "pose"],
        "fieldtypes": ["std_msgs/Header", "geometry_msgs/Pose"],
        "fieldarraylen": [-1, -1],
        "examples": ["{}", "{}"],
        "constnames": [],
        "constvalues": [],
    }
    embedded = "std_msgs/Header time geometry_msgs/Pose geometry_msgs/Point geometry_msgs/Quaternion"
    assert [each["type"] for each in others] == embedded.split()
    assert (
        _rosapi(robot, "message_details", type="float64")["typedefs"] == []
    )  # clients ask for the type of each field
    log = _rosapi(robot, "message_details", type="rosgraph_msgs/Log")["typedefs"][0]
    assert dict(zip(log["constnames"], log["constvalues"], strict=True))["ERROR"] == "8"
    info = _rosapi(robot, "message_details", type="sensor_msgs/CameraInfo")["typedefs"][0]
    shapes = dict(zip(info["fieldnames"], info["fieldarraylen"], strict=True))
    assert (shapes["D"], shapes["K"], shapes["height"]) == (0, 9, -1)
    (request,) = _rosapi(robot, "service_request_details", type=ADD)["typedefs"]
    assert (request["type"], request["fieldnames"]) == (f"{ADD}Request", ["a", "b"])
    assert request["examples"] == ["0", "0"]
    (response,) = _rosapi(robot, "service_response_details", type=ADD)["typedefs"]
    assert response["fieldnames"] == ["sum"]


def test_the_sums_of_rosapi_are_those_of_genmsg() -> None:
    lines = Path(__file__).with_name("rosapi.md5").read_text().splitlines()  # as Debian's genmsg computes them
    assert {name: ServiceType(name).md5sum for name in SERVICES.values()} == dict(map(str.split, lines))
    assert MessageType("rosapi/TypeDef").md5sum == "80597571d79bbeef6c9c4d98f30116a0"
    assert MessageType("rosbridge_msgs/ConnectedClients").md5sum == "d0d53b0c0aa23aa7e4cf52f49bca4b69"
