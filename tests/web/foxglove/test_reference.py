"""The same dialogue with foxglove-sdk's server and with ours: both say the same, to the byte.

Skipped where the extra ``web-peers`` is not installed.
"""

from __future__ import annotations

import contextlib
import struct
from typing import TYPE_CHECKING, Any

import msgspec
import pytest

foxglove = pytest.importorskip("foxglove", reason="foxglove-sdk is not installed (extra web-peers)")
websockets_client = pytest.importorskip("websockets.sync.client", reason="websockets is not installed (web-peers)")

from foxglove import Channel, Schema, websocket  # noqa: E402 - after the skip

from rmpa.core.errors import RmpaError  # noqa: E402
from rmpa.ros.types.installed import ServiceType  # noqa: E402
from rmpa.ros.types.messages import MessageType  # noqa: E402
from rmpa.web.hub.graph import GraphTopic  # noqa: E402
from tests.web.foxglove.client import SET_BOOL, Client  # noqa: E402
from tests.web.recorder import NOW_NS as STAMP  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Iterator

TEXT = MessageType("nav_msgs/Odometry").definition
TOPIC = GraphTopic("/odom", ("nav_msgs/Odometry",), ("/base",), ("/map",))
PARAMETERS: dict[str, Any] = {"/a": 1, "/b": b"ABCD", "/c": [1.5, 2.0], "/d": {"x": [True, "y"]}}


class Listener(websocket.ServerListener):  # type: ignore[misc]
    """Holds parameters for the reference."""

    def on_get_parameters(self, client: Any, names: Any, request_id: Any = None) -> list[Any]:
        return parameters()

    def on_set_parameters(self, client: Any, parameters: list[Any], request_id: Any = None) -> list[Any]:
        return parameters


def parameters() -> list[Any]:
    value = websocket.ParameterValue
    kind = websocket.ParameterType
    return [
        websocket.Parameter("/a", value=value.Integer(1)),
        websocket.Parameter("/b", value=value.String("QUJDRA=="), type=kind.ByteArray),
        websocket.Parameter(
            "/c", value=value.Array([value.Float64(1.5), value.Float64(2.0)]), type=kind.Float64Array
        ),
        websocket.Parameter("/d", value=value.Dict({"x": value.Array([value.Bool(True), value.String("y")])})),
    ]


class Reference:
    """foxglove-sdk's server with one topic and one service, and a client of it."""

    def __init__(self) -> None:
        types = ServiceType("std_srvs/SetBool")
        request, response = (
            websocket.MessageSchema(
                encoding="ros1", schema=Schema(name=each.name, encoding="ros1msg", data=each.definition.encode())
            )
            for each in (types.request, types.response)
        )
        service = websocket.Service(
            "/set_bool",
            schema=websocket.ServiceSchema("std_srvs/SetBool", request=request, response=response),
            handler=lambda call: call.payload + b"\x00\x00\x00\x00",
        )
        can = websocket.Capability
        # Kept: the channel is withdrawn with its context.
        self._context = context = foxglove.Context()
        schema = Schema(name="nav_msgs/Odometry", encoding="ros1msg", data=TEXT.encode())
        self.channel = Channel("/odom", message_encoding="ros1", schema=schema, context=context)
        self.server = foxglove.start_server(
            port=0,
            name="base",
            session_id="run-1",
            capabilities=[can.ClientPublish, can.Parameters, can.Services, can.ConnectionGraph],
            supported_encodings=["ros1"],
            server_listener=Listener(),
            services=[service],
            asset_handler=lambda uri: b"solid" if uri == "package://robot/base.stl" else None,
            context=context,
        )
        graph = websocket.ConnectionGraph()
        graph.set_published_topic("/odom", ["/base"])
        graph.set_subscribed_topic("/odom", ["/map"])
        graph.set_advertised_service("/set_bool", ["/server"])
        self.server.publish_connection_graph(graph)
        address = f"ws://127.0.0.1:{self.server.port}"
        self._connected = contextlib.ExitStack()
        self.client = self._connected.enter_context(
            websockets_client.connect(address, subprotocols=["foxglove.sdk.v1"])
        )

    def receive(self) -> bytes:
        data = self.client.recv(timeout=30)
        return data.encode() if isinstance(data, str) else bytes(data)

    def ask(self, message: dict[str, Any] | bytes) -> bytes:
        self.client.send(message if isinstance(message, bytes) else msgspec.json.encode(message).decode())
        return self.receive()

    def close(self) -> None:
        self._connected.close()
        self.server.stop()


@pytest.fixture
def reference() -> Iterator[Reference]:
    made = Reference()
    yield made
    made.close()


class Ours(Client):
    """Our session; its frames as bytes, in order."""

    @property
    def said(self) -> list[bytes]:
        return [b"".join(parts) for _, parts in self.connection.sent]

    def ask(self, frame: dict[str, Any] | bytes) -> bytes | None:
        count = len(self.said)
        self.send(frame)
        return self.said[-1] if len(self.said) > count else None


def test_both_servers_say_the_same(reference: Reference) -> None:
    ours = Ours()
    ours.graph(TOPIC, SET_BOOL)
    first, mine = (msgspec.json.decode(each) for each in (reference.receive(), ours.said[0]))
    first.pop("metadata")
    mine.pop("metadata")
    assert mine == first
    assert list(mine) == list(first)
    advertised, services = reference.receive(), reference.receive()
    assert ours.said[1:3] == [with_id(advertised, "channels"), services]

    channel = reference.channel.id()
    reference.client.send(f'{{"op":"subscribe","subscriptions":[{{"id":7,"channelId":{channel}}}]}}')
    wrong = {"op": "fetchAsset", "uri": "package://robot/none", "requestId": 9}
    failed = reference.ask(wrong)  # its answer shows that the subscription has been read
    reference.channel.log(b"payload", log_time=STAMP)
    ours.subscribe(1, 7).message(b"payload", "nav_msgs/Odometry")
    assert ours.said[-1] == reference.receive()
    ours.ask(wrong)
    ours.last("fetch_asset").failed(RmpaError("OSError: not found"))
    assert ours.said[-1] == failed

    call = struct.pack("<BIII", 2, 1, 12, 4) + b"ros1\x01"
    ours.ask(call)
    ours.last("call").done(b"\x01\x00\x00\x00\x00")
    assert ours.said[-1] == reference.ask(call)

    fetch = {"op": "fetchAsset", "uri": "package://robot/base.stl", "requestId": 5}
    ours.ask(fetch)
    ours.last("fetch_asset").done(b"solid")
    assert ours.said[-1] == reference.ask(fetch)

    get = {"op": "getParameters", "parameterNames": [], "id": "r1"}
    ours.ask(get)
    ours.last("get_params").done(PARAMETERS)
    assert ours.said[-1] == reference.ask(get)

    change = {
        "op": "setParameters",
        "parameters": [{"name": "/b", "type": "byte_array", "value": "QUI="}],
        "id": "r2",
    }
    ours.ask(change)
    assert ours.said[-1] == reference.ask(change)

    follow = {"op": "subscribeConnectionGraph"}
    assert ours.ask(follow) == reference.ask(follow)


@pytest.mark.parametrize(
    "wrong",
    [
        {"op": "nonsense"},
        {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 4444}]},
        {"op": "setParameters", "parameters": [{"name": "/a", "value": [None]}]},
        b"\x09",
        struct.pack("<BI", 1, 9) + b"x",
        struct.pack("<BIII", 2, 1, 12, 400) + b"ros1",
        struct.pack("<BIII", 2, 1, 12, 4) + b"jsonx",
        struct.pack("<BIII", 2, 77, 12, 4) + b"ros1",
    ],
    ids=str,
)
def test_both_servers_refuse_the_same_in_the_same_way(reference: Reference, wrong: Any) -> None:
    ours = Ours()
    ours.graph(TOPIC, SET_BOOL)
    for _ in range(3):
        reference.receive()
    theirs, mine = (msgspec.json.decode(each) for each in (reference.ask(wrong), ours.ask(wrong) or b"null"))
    assert theirs.pop("message")
    assert mine.pop("message")
    assert mine == theirs


def with_id(advertised: bytes, key: str) -> bytes:
    """The reference's message with the id 1: it counts over all servers of a process."""
    found = msgspec.json.decode(advertised)
    found[key][0]["id"] = 1
    return msgspec.json.encode(found)
