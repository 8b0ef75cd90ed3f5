"""Calls of a client, services that it offers, and rosapi, through its session."""

from __future__ import annotations

import json
from typing import Any, cast

import cbor2
import msgspec
import pytest

from rmpa.ros.types.codec import codec_for
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType
from rmpa.web import limits
from rmpa.web.hub.requests import (
    CallService,
    CancelCall,
    DeleteParam,
    EndService,
    Failed,
    FindService,
    FindServices,
    ParamsChanged,
    Respond,
    ServeService,
    ServiceFound,
    ServiceRequest,
    ServiceResult,
    SetParam,
)
from rmpa.web.rosbridge.protocol import decode_png
from rmpa.web.rosbridge.rosapi import Rosapi
from tests.web.rosbridge.hub import NOW_NS, Client, Types

ADD = "rospy_tutorials/AddTwoInts"
TWENTY_AND_TWO = b"\x14" + bytes(7) + b"\x02" + bytes(7)
TWENTY_TWO = b"\x16" + bytes(7)


# --- calls -------------------------------------------------------------------------------------------------------


def _client() -> Client:
    client = Client()
    client.graph.add_service("/add", ADD)
    return client


@pytest.mark.parametrize("args", [{"a": 20, "b": 2}, [20, 2]])
def test_a_call_and_its_answer(args: Any) -> None:
    client = _client()
    call = client.one(CallService, client.send("call_service", id="c", service="add", args=args, timeout=3))
    assert (call.service, call.type, call.request, call.timeout) == ("/add", ADD, TWENTY_AND_TWO, 3)
    client.answer(ServiceResult(call.handle, ok=True, payload=TWENTY_TWO))
    (frame,) = client.frames()
    assert frame.data == b'{"op":"service_response","service":"add","values":{"sum":22},"result":true,"id":"c"}'
    client.answer(ServiceResult(call.handle, ok=True, payload=TWENTY_TWO))
    assert not client.frames()


def test_the_answer_comes_in_the_compression_and_fragments_that_were_asked_for() -> None:
    client = _client()
    for compression in ("png", "cbor", "none"):
        op = {"id": "c", "service": "/add", "args": [20, 2], "compression": compression, "fragment_size": 4000}
        call = client.one(CallService, client.send("call_service", **op))
        client.answer(ServiceResult(call.handle, ok=True, payload=TWENTY_TWO))
    png, cbor, none = client.received()
    want = {"op": "service_response", "service": "/add", "id": "c", "values": {"sum": 22}, "result": True}
    assert json.loads(decode_png(png["data"])) == cbor == none == want
    call = client.one(CallService, client.send("call_service", id="c", service="/add", args=[1, 1], fragment_size=10))
    client.answer(ServiceResult(call.handle, ok=True, payload=TWENTY_TWO))
    fragments = client.received()
    assert {each["id"] for each in fragments} == {"c"}
    assert json.loads("".join(each["data"] for each in fragments)) == want


def test_an_old_client_gives_its_id_with_the_name() -> None:
    client = _client()
    call = client.one(CallService, client.send("call_service", service="/add#7", args=[1, 1]))
    assert call.service == "/add"
    client.answer(ServiceResult(call.handle, ok=True, payload=TWENTY_TWO))
    assert client.received()[0]["id"] == "7"


def test_a_service_of_unknown_type_is_looked_up_first() -> None:
    client = Client()
    find = client.one(FindService, client.send("call_service", id="c", service="/add", args=[20, 2]))
    assert find.service == "/add"
    call = client.one(CallService, client.answer(ServiceFound(find.handle, ADD)))
    assert call.request == TWENTY_AND_TWO
    client.answer(ServiceResult(call.handle, ok=True, payload=TWENTY_TWO))
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
def test_a_call_that_cannot_be_made_has_an_answer_and_nothing_beside_it(op: dict[str, Any], says: str) -> None:
    client = _client()
    assert not client.send("call_service", id="c", **op)
    (answer,) = client.received()
    assert (answer["op"], answer["result"], answer["id"]) == ("service_response", False, "c")
    assert says in answer["values"]


def test_a_call_that_fails_says_why() -> None:
    client = _client()
    for answer in (
        lambda handle: ServiceResult(handle, ok=False, error="the server raised"),
        lambda handle: Failed(handle, "the server raised", "look at its log"),
        lambda handle: ServiceResult(handle, ok=True, payload=b"short"),
    ):
        call = client.one(CallService, client.send("call_service", id="c", service="/add", args=[1, 1]))
        client.answer(answer(call.handle))
        (response,) = client.received()
        assert not response["result"]
        assert "the server raised" in response["values"] or "5 bytes are not" in response["values"]


def test_open_calls_are_bounded_and_end_with_the_client() -> None:
    client = _client()
    for _ in range(limits.CALLS_MAX + 2):
        client.send("call_service", service="/add", args=[1, 1])
    assert [each["result"] for each in client.received()] == [False, False]
    client.session.close()
    requests = client.session.requests_to_send()
    assert len(requests) == limits.CALLS_MAX
    assert isinstance(requests[0], CancelCall)


# --- services of the client --------------------------------------------------------------------------------------


def test_a_client_serves() -> None:
    client = Client()
    serve = client.one(ServeService, client.send("advertise_service", service="/add", type=ADD))
    assert (serve.service, serve.type) == ("/add", ADD)
    client.answer(ServiceRequest(serve.handle, 77, TWENTY_AND_TWO))
    (call,) = client.received()
    assert call == {
        "op": "call_service",
        "id": "service_request:/add:1",
        "service": "/add",
        "args": {"a": 20, "b": 2},
    }
    response = {"id": call["id"], "service": "/add", "values": {"sum": 22}, "result": True}
    assert client.send("service_response", **response) == [Respond(serve.handle, 77, True, TWENTY_TWO)]
    assert not client.send("service_response", **response)
    assert "no open call" in client.error()
    assert client.send("unadvertise_service", service="/add") == [EndService(serve.handle)]


def test_a_clients_service_may_fail_or_answer_wrongly() -> None:
    client = Client()
    serve = client.one(ServeService, client.send("advertise_service", service="/add", type=ADD))
    for op, says in (
        ({"result": False, "values": "no luck"}, "no luck"),
        ({"result": False}, "the service failed"),
        ({"result": True, "values": {"sum": "x"}}, "sum: is a int64, not 'x'"),
    ):
        client.answer(ServiceRequest(serve.handle, 5, TWENTY_AND_TWO))
        (call,) = client.received()
        (respond,) = client.send("service_response", id=call["id"], service="/add", **op)
        assert isinstance(respond, Respond)
        assert not respond.ok
        assert says in str(respond.response)
        client.received()
    (respond,) = client.answer(ServiceRequest(serve.handle, 6, b"short"))
    assert isinstance(respond, Respond)
    assert not respond.ok


def test_open_requests_fail_when_the_service_or_the_client_ends() -> None:
    client = Client()
    first = client.one(ServeService, client.send("advertise_service", service="/add", type=ADD))
    client.answer(ServiceRequest(first.handle, 1, TWENTY_AND_TWO))
    refuse, end, again = client.send("advertise_service", service="/add", type=ADD)
    assert isinstance(refuse, Respond)
    assert (refuse.call, refuse.ok) == (1, False)
    assert end == EndService(first.handle)
    assert isinstance(again, ServeService)
    (late,) = client.answer(ServiceRequest(first.handle, 2, TWENTY_AND_TWO))
    assert isinstance(late, Respond)
    assert not late.ok
    client.answer(ServiceRequest(again.handle, 3, TWENTY_AND_TWO))
    client.session.close()
    refuse, end = client.session.requests_to_send()
    assert isinstance(refuse, Respond)
    assert (refuse.call, refuse.ok) == (3, False)
    assert end == EndService(again.handle)


def test_a_service_that_the_hub_cannot_offer_is_reported() -> None:
    client = Client()
    serve = client.one(ServeService, client.send("advertise_service", service="/add", type=ADD))
    client.answer(Failed(serve.handle, "the name is taken", "choose another"))
    assert client.error() == "advertise_service /add: the name is taken; choose another"


def test_requests_to_a_client_that_does_not_answer_are_bounded() -> None:
    client = Client()
    serve = client.one(ServeService, client.send("advertise_service", service="/add", type=ADD))
    refused = [
        each
        for number in range(limits.REQUESTS_MAX + 3)
        for each in client.answer(ServiceRequest(serve.handle, number, TWENTY_AND_TWO))
    ]
    assert len(refused) == 3


# --- rosapi ------------------------------------------------------------------------------------------------------


def _robot() -> Client:
    client = Client()
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
    graph.params = {"rate": 10, "ns": {"deep": {"x": 1.5, "y": [1, "b"]}, "empty": {}}, "rosapi": {"mine": True}}
    return client


def _ask(client: Client, service: str, /, **args: Any) -> Any:
    assert not client.send("call_service", service=f"/rosapi/{service}", args=args)
    (answer,) = client.received()
    assert answer["result"], answer
    values = answer["values"]
    # What JSON clients get is also a valid ROS response.
    rosapi = Rosapi(cast("Any", client.graph), cast("Any", Types()), lambda: NOW_NS)
    codec_for(ServiceType(rosapi.services[f"/rosapi/{service}"]).response).write(values, 0)
    return values


def test_topics() -> None:
    client = _robot()
    topics = _ask(client, "topics")
    assert topics["topics"] == list(client.graph.topics)
    assert dict(zip(topics["topics"], topics["types"], strict=True))["/untyped"] == ""
    raw = _ask(client, "topics_and_raw_types")
    texts = dict(zip(raw["types"], raw["typedefs_full_text"], strict=True))
    assert texts["std_msgs/String"] == MessageType("std_msgs/String").definition
    assert texts["no_such/Type"] == texts[""] == ""
    assert _ask(client, "topics_for_type", type="std_msgs/String") == {"topics": ["/b/goal"]}
    assert _ask(client, "topic_type", topic="/b/goal") == {"type": "std_msgs/String"}
    assert _ask(client, "topic_type", topic="/none") == {"type": ""}
    assert _ask(client, "publishers", topic="/b/goal") == {"publishers": ["/talker", "/other"]}
    assert _ask(client, "subscribers", topic="/b/goal") == {"subscribers": ["/listener"]}
    assert _ask(client, "subscribers", topic="/none") == {"subscribers": []}
    assert _ask(client, "action_servers") == {"action_servers": ["/a", "/arm/dock"]}


def test_services() -> None:
    client = _robot()
    assert _ask(client, "services") == {"services": ["/add", "/unknown"]}
    assert _ask(client, "service_type", service="/add") == {"type": ADD}
    assert _ask(client, "service_type", service="/none") == {"type": ""}
    assert _ask(client, "service_type", service="/rosapi/topics") == {"type": "rosapi/Topics"}
    assert _ask(client, "service_node", service="/add") == {"node": "/server"}
    assert _ask(client, "service_node", service="/none") == {"node": ""}
    assert _ask(client, "service_host", service="/add") == {"host": "robot"}
    assert _ask(client, "service_host", service="/unknown") == {"host": "::1"}
    assert _ask(client, "service_host", service="/none") == {"host": ""}
    assert _ask(client, "service_providers", service="/add") == {"providers": ["/server"]}


@pytest.mark.parametrize(
    ("service", "args", "values"),
    [
        ("services_for_type", {"type": ADD}, {"services": ["/add", "/late"]}),
        ("service_providers", {"service": ADD}, {"providers": ["/server", "/slow"]}),
    ],
)
def test_servers_that_did_not_tell_their_type_are_asked_before_services_are_listed_by_type(
    service: str, args: dict[str, str], values: dict[str, list[str]]
) -> None:
    client = _robot()
    client.graph.add_service("/late", "", "/slow")
    find = client.one(FindServices, client.send("call_service", service=f"/rosapi/{service}", args=args))
    assert client.received() == []
    client.graph.add_service("/late", ADD, "/slow")
    client.answer(ServiceFound(find.handle, ""))
    assert client.received()[0]["values"] == values


def test_the_type_of_a_service_that_the_graph_does_not_know_is_looked_up() -> None:
    client = _robot()
    for answer, kind in ((lambda handle: ServiceFound(handle, ADD), ADD), (lambda handle: Failed(handle, "no"), "")):
        requests = client.send("call_service", service="/rosapi/service_type", args={"service": "/unknown"})
        find = client.one(FindService, requests)
        client.answer(answer(find.handle))
        assert client.received()[0]["values"] == {"type": kind}


def test_nodes_and_time() -> None:
    client = _robot()
    assert _ask(client, "nodes") == {"nodes": list(client.graph.nodes)}
    details = {"subscribing": ["/b/goal", "/untyped"], "publishing": [], "services": []}
    assert _ask(client, "node_details", node="/listener") == details
    assert _ask(client, "node_details", node="/server")["services"] == ["/add"]
    secs, nsecs = divmod(NOW_NS, 10**9)
    assert _ask(client, "get_time") == {"time": {"secs": secs, "nsecs": nsecs}}


def test_parameters_are_read() -> None:
    client = _robot()
    assert json.loads(_ask(client, "get_param", name="/ns/deep")["value"]) == {"x": 1.5, "y": [1, "b"]}
    assert _ask(client, "get_param", name="rate", default="5") == {"value": "10"}
    assert _ask(client, "get_param", name="/none", default="5") == {"value": "5"}
    assert _ask(client, "get_param", name="/none", default="text") == {"value": '"text"'}
    assert _ask(client, "get_param", name="/none") == {"value": "null"}
    assert _ask(client, "has_param", name="/ns/deep/x") == {"exists": True}
    assert _ask(client, "has_param", name="/rate/x") == {"exists": False}
    names = ["/ns/deep/x", "/ns/deep/y", "/ns/empty", "/rate", "/rosapi/mine"]
    assert _ask(client, "get_param_names") == {"names": names}
    assert _ask(client, "search_param", name="rate") == {"global_name": "/rate"}
    assert _ask(client, "search_param", name="mine") == {"global_name": "/rosapi/mine"}
    assert _ask(client, "search_param", name="none") == {"global_name": ""}
    assert _ask(client, "search_param", name="/ns/deep") == {"global_name": "/ns/deep"}


def test_parameters_are_set_and_deleted_by_the_hub() -> None:
    client = _robot()
    args = {"name": "/new", "value": '{"a": [1, 2.5]}'}
    request = client.one(SetParam, client.send("call_service", id="s", service="/rosapi/set_param", args=args))
    assert (request.name, request.value) == ("/new", {"a": [1, 2.5]})
    assert not client.received()
    client.answer(ParamsChanged(request.handle, {"/new": {"a": [1, 2.5]}}))
    (answer,) = client.received()
    assert (answer["id"], answer["result"], answer["values"]) == ("s", True, {})
    args = {"name": "/rate"}
    delete = client.one(DeleteParam, client.send("call_service", id="d", service="/rosapi/delete_param", args=args))
    client.answer(Failed(delete.handle, "read-only"))
    assert client.received()[0]["result"] is False
    assert _ask(client, "delete_param", name="/none") == {}


def test_details_of_types() -> None:
    client = _robot()
    first, *others = _ask(client, "message_details", type="geometry_msgs/PoseStamped")["typedefs"]
    assert first == {
        "type": "geometry_msgs/PoseStamped",
        "fieldnames": ["header", "pose"],
        "fieldtypes": ["std_msgs/Header", "geometry_msgs/Pose"],
        "fieldarraylen": [-1, -1],
        "examples": ["{}", "{}"],
        "constnames": [],
        "constvalues": [],
    }
    names = [each["type"] for each in others]
    assert names == [
        "std_msgs/Header",
        "time",
        "geometry_msgs/Pose",
        "geometry_msgs/Point",
        "geometry_msgs/Quaternion",
    ]
    (log,) = (
        each
        for each in _ask(client, "message_details", type="rosgraph_msgs/Log")["typedefs"]
        if each["type"] == "rosgraph_msgs/Log"
    )
    assert dict(zip(log["constnames"], log["constvalues"], strict=True))["ERROR"] == "8"
    info = _ask(client, "message_details", type="sensor_msgs/CameraInfo")["typedefs"][0]
    shapes = dict(zip(info["fieldnames"], info["fieldarraylen"], strict=True))
    assert (shapes["D"], shapes["K"], shapes["height"]) == (0, 9, -1)
    (request,) = _ask(client, "service_request_details", type=ADD)["typedefs"]
    assert (request["type"], request["fieldnames"]) == (f"{ADD}Request", ["a", "b"])
    assert request["examples"] == ["0", "0"]
    (response,) = _ask(client, "service_response_details", type=ADD)["typedefs"]
    assert response["fieldnames"] == ["sum"]


def test_the_answer_of_rosapi_in_cbor() -> None:
    client = _robot()
    client.send("call_service", service="/rosapi/services", compression="cbor")
    (frame,) = client.frames()
    assert cbor2.loads(bytes(frame.data))["values"] == {"services": ["/add", "/unknown"]}


MD5 = """
rosapi/DeleteParam c1f3d28f1b044c871e6eff2e9fc3c667
rosapi/GetActionServers 46807ba271844ac5ba4730a47556b236
rosapi/GetParam e36fd90759dbac1c5159140a7fa8c644
rosapi/GetParamNames dc7ae3609524b18034e49294a4ce670e
rosapi/GetTime 556a4fb76023a469987922359d08a844
rosapi/HasParam ed3df286bd6dff9b961770f577454ea9
rosapi/MessageDetails f9c88144f6f6bd888dd99d4e0411905d
rosapi/NodeDetails e1d0ced5ab8d5edb5fc09c98eb1d46f6
rosapi/Nodes 3d07bfda1268b4f76b16b7ba8a82665d
rosapi/Publishers cb37f09944e7ba1fc08ee38f7a94291d
rosapi/SearchParam dfadc39f113c1cc6d7759508d8461d5a
rosapi/ServiceHost a1b60006f8ee69637c856c94dd192f5a
rosapi/ServiceNode bd2a0a45fd7a73a86c8d6051d5a6db8a
rosapi/ServiceProviders f30b41d5e347454ae5483ee95eef5cc6
rosapi/ServiceRequestDetails f9c88144f6f6bd888dd99d4e0411905d
rosapi/ServiceResponseDetails f9c88144f6f6bd888dd99d4e0411905d
rosapi/ServiceType 0e24a2dcdf70e483afc092a35a1f15f7
rosapi/Services e44a7e7bcb900acadbcc28b132378f0c
rosapi/ServicesForType 93e9fe8ae5a9136008e260fe510bd2b0
rosapi/SetParam bc6ccc4a57f61779c8eaae61e9f422e0
rosapi/Subscribers cb387b68f5b29bc1456398ee8476b973
rosapi/TopicType 0d30b3f53a0fd5036523a7141e524ddf
rosapi/Topics d966d98fc333fa1f3135af765eac1ba8
rosapi/TopicsAndRawTypes e1432466c8f64316723276ba07c59d12
rosapi/TopicsForType 56f77ff6da756dd27c1ed16ec721072a
"""
"""As Debian's genmsg computes them."""


def test_the_sums_of_rosapi_are_those_of_genmsg() -> None:
    sums = dict(line.split() for line in MD5.split("\n") if line)
    offered = Rosapi(cast("Any", _robot().graph), cast("Any", Types()), lambda: 0).services.values()
    assert {name: ServiceType(name).md5sum for name in offered} == sums
    assert MessageType("rosapi/TypeDef").md5sum == "80597571d79bbeef6c9c4d98f30116a0"
    assert MessageType("rosbridge_msgs/ConnectedClients").md5sum == "d0d53b0c0aa23aa7e4cf52f49bca4b69"


def test_frames_of_answers_are_json() -> None:
    client = _robot()
    client.send("call_service", service="/rosapi/nodes")
    (frame,) = client.frames()
    assert msgspec.json.decode(frame.data)["values"]["nodes"]
