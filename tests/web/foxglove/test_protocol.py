"""The Foxglove protocol's messages: golden bytes of foxglove-sdk 0.30.3, and what broken frames come to."""

from __future__ import annotations

import struct

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import LimitExceeded, RemoteProtocolError
from rmpa.web import limits
from rmpa.web.foxglove import protocol
from rmpa.web.foxglove.channels import to_parameter
from rmpa.web.foxglove.protocol import Capability

SET_BOOL = {
    half: protocol.ServiceSchema(
        encoding="ros1", schema_name=f"std_srvs/SetBool{half}", schema_encoding="ros1msg", schema=schema
    )
    for half, schema in (("Request", "bool data"), ("Response", "bool success\nstring message"))
}
JSON = {
    "server info": (
        protocol.ServerInfo(
            name="base",
            capabilities=(
                Capability.CLIENT_PUBLISH,
                Capability.PARAMETERS,
                Capability.PARAMETERS_SUBSCRIBE,
                Capability.SERVICES,
                Capability.TIME,
                Capability.CONNECTION_GRAPH,
                Capability.ASSETS,
            ),
            supported_encodings=("ros1",),
            metadata={"fg-library": "foxglove-sdk-python/0.30.3"},
            session_id="s1",
        ),
        (
            b'{"op":"serverInfo","name":"base","capabilities":["clientPublish","parameters","parametersSubscribe",'
            b'"services","time","connectionGraph","assets"],"supportedEncodings":["ros1"],'
            b'"metadata":{"fg-library":"foxglove-sdk-python/0.30.3"},"sessionId":"s1"}'
        ),
    ),
    "advertise": (
        protocol.FoxgloveAdvertise(
            channels=(
                protocol.Channel(
                    id=1,
                    topic="/chatter",
                    encoding="ros1",
                    schema_name="std_msgs/String",
                    schema_encoding="ros1msg",
                    schema="string data",
                ),
            )
        ),
        (
            b'{"op":"advertise","channels":[{"id":1,"topic":"/chatter","encoding":"ros1",'
            b'"schemaName":"std_msgs/String","schemaEncoding":"ros1msg","schema":"string data"}]}'
        ),
    ),
    "unadvertise": (protocol.FoxgloveUnadvertise(channel_ids=(1,)), b'{"op":"unadvertise","channelIds":[1]}'),
    "advertise services": (
        protocol.FoxgloveAdvertiseServices(
            services=(
                protocol.FoxgloveService(
                    id=1,
                    name="/set_bool",
                    type="std_srvs/SetBool",
                    request=SET_BOOL["Request"],
                    response=SET_BOOL["Response"],
                ),
            )
        ),
        (
            b'{"op":"advertiseServices","services":[{"id":1,"name":"/set_bool","type":"std_srvs/SetBool",'
            b'"request":{"encoding":"ros1","schemaName":"std_srvs/SetBoolRequest","schemaEncoding":"ros1msg",'
            b'"schema":"bool data"},"response":{"encoding":"ros1","schemaName":"std_srvs/SetBoolResponse",'
            b'"schemaEncoding":"ros1msg","schema":"bool success\\nstring message"}}]}'
        ),
    ),
    "unadvertise services": (
        protocol.FoxgloveUnadvertiseServices(service_ids=(1,)),
        b'{"op":"unadvertiseServices","serviceIds":[1]}',
    ),
    "status with id": (
        protocol.FoxgloveStatus(level=1, message="msg", id="i1"),
        b'{"op":"status","level":1,"message":"msg","id":"i1"}',
    ),
    "status": (protocol.FoxgloveStatus(level=2, message="x"), b'{"op":"status","level":2,"message":"x"}'),
    "remove status": (protocol.RemoveStatus(status_ids=("i1",)), b'{"op":"removeStatus","statusIds":["i1"]}'),
    "parameters": (
        protocol.ParameterValues(
            parameters=(
                to_parameter("/a", 1),
                to_parameter("/c", b"ABCD"),
                to_parameter("/d", [1.5, 2.0]),
                to_parameter("/e", {"x": True}),
            ),
            id="r1",
        ),
        (
            b'{"op":"parameterValues","parameters":[{"name":"/a","value":1},'
            b'{"name":"/c","type":"byte_array","value":"QUJDRA=="},'
            b'{"name":"/d","type":"float64_array","value":[1.5,2.0]},{"name":"/e","value":{"x":true}}],"id":"r1"}'
        ),
    ),
    "parameter update": (
        protocol.ParameterValues(parameters=(to_parameter("/a", 6),)),
        b'{"op":"parameterValues","parameters":[{"name":"/a","value":6}]}',
    ),
    "call failure": (
        protocol.ServiceCallFailure(service_id=1, call_id=12, message="Unsupported encoding"),
        b'{"op":"serviceCallFailure","serviceId":1,"callId":12,"message":"Unsupported encoding"}',
    ),
    "connection graph": (
        protocol.ConnectionGraphUpdate(
            published_topics=(protocol.PublishedTopic(name="/t", publisher_ids=("/n1",)),),
            subscribed_topics=(protocol.SubscribedTopic(name="/t", subscriber_ids=("/n2",)),),
            advertised_services=(protocol.AdvertisedService(name="/s", provider_ids=("/n1",)),),
            removed_topics=(),
            removed_services=(),
        ),
        (
            b'{"op":"connectionGraphUpdate","publishedTopics":[{"name":"/t","publisherIds":["/n1"]}],'
            b'"subscribedTopics":[{"name":"/t","subscriberIds":["/n2"]}],'
            b'"advertisedServices":[{"name":"/s","providerIds":["/n1"]}],"removedTopics":[],"removedServices":[]}'
        ),
    ),
}
BINARY = {
    "message data": (
        protocol.message_data(7, 1234567890123456789, b"\x02\x00\x00\x00hi"),
        b'\x01\x07\x00\x00\x00\x15\x81\xe9}\xf4\x10"\x11\x02\x00\x00\x00hi',
    ),
    "time": (protocol.server_time(99), b"\x02c\x00\x00\x00\x00\x00\x00\x00"),
    "service response": (
        protocol.service_response(1, 12, b"\x01\x00\x00\x00\x00"),
        b"\x03\x01\x00\x00\x00\x0c\x00\x00\x00\x04\x00\x00\x00ros1\x01\x00\x00\x00\x00",
    ),
    "asset": (protocol.asset_response(5, b"hi"), b"\x04\x05\x00\x00\x00\x00\x00\x00\x00\x00hi"),
    "asset failure": (
        protocol.asset_failure(6, "OSError: not found"),
        b"\x04\x06\x00\x00\x00\x01\x12\x00\x00\x00OSError: not found",
    ),
}


@pytest.mark.parametrize("name", JSON)
def test_json_messages_are_those_of_the_reference(name: str) -> None:
    message, golden = JSON[name]
    assert message.frame().data == golden


@pytest.mark.parametrize("name", BINARY)
def test_binary_messages_are_those_of_the_reference(name: str) -> None:
    frame, golden = BINARY[name]
    assert bytes(frame) == golden
    assert len(frame) == len(golden)


def test_a_large_payload_is_handed_on_and_not_copied() -> None:
    payload = memoryview(bytearray(1_000_000))
    frame = protocol.message_data(1, 0, payload)
    assert frame.payload is payload
    assert len(frame.header) == 13


def test_both_names_of_the_subprotocol_are_accepted() -> None:
    assert protocol.choose_subprotocol(["foxglove.websocket.v1"]) == "foxglove.websocket.v1"
    assert protocol.choose_subprotocol(["x", " foxglove.websocket.v1 ", "foxglove.sdk.v1"]) == "foxglove.sdk.v1"
    assert protocol.choose_subprotocol(["rosbridge"]) is None


def test_text_that_is_not_utf8_reaches_the_client_as_replacement_characters() -> None:
    message = protocol.FoxgloveStatus(level=0, message="caf\udce9").frame()
    assert "caf\N{REPLACEMENT CHARACTER}" in message.data.decode()


CLIENT = {
    '{"op":"subscribe","subscriptions":[{"id":0,"channelId":3},{"id":1,"channelId":5}]}': protocol.FoxgloveSubscribe(
        (protocol.FoxgloveSubscription(0, 3), protocol.FoxgloveSubscription(1, 5))
    ),
    '{"op":"unsubscribe","subscriptionIds":[0,1]}': protocol.FoxgloveUnsubscribe((0, 1)),
    '{"op":"advertise","channels":[{"id":4,"topic":"/cmd","encoding":"ros1","schemaName":"std_msgs/String",'
    '"schema":"string data","schemaEncoding":"ros1msg"}]}': protocol.ClientAdvertise(
        (protocol.ClientChannel(4, "/cmd", "ros1", "std_msgs/String", "string data", "ros1msg"),)
    ),
    '{"op":"unadvertise","channelIds":[1,2]}': protocol.ClientUnadvertise((1, 2)),
    '{"op":"getParameters","parameterNames":["/a"],"id":"r"}': protocol.GetParameters(("/a",), "r"),
    '{"op":"setParameters","parameters":[{"name":"/a","value":3},{"name":"/b"}]}': protocol.SetParameters(
        (protocol.FoxgloveParameter(name="/a", value=3), protocol.FoxgloveParameter(name="/b"))
    ),
    '{"op":"subscribeParameterUpdates","parameterNames":["/a"]}': protocol.SubscribeParameterUpdates(("/a",)),
    '{"op":"unsubscribeParameterUpdates","parameterNames":[]}': protocol.UnsubscribeParameterUpdates(),
    '{"op":"subscribeConnectionGraph"}': protocol.SubscribeConnectionGraph(),
    '{"op":"unsubscribeConnectionGraph","later":1}': protocol.UnsubscribeConnectionGraph(),
    '{"op":"fetchAsset","uri":"package://foo/robot.urdf","requestId":123}': protocol.FoxgloveFetchAsset(
        "package://foo/robot.urdf", 123
    ),
}


@pytest.mark.parametrize("text", CLIENT)
def test_each_message_of_a_client_is_read(text: str) -> None:
    assert protocol.parse_text(text) == CLIENT[text]
    assert protocol.parse_text(text.encode()) == CLIENT[text]


def test_binary_messages_of_a_client_are_read_without_a_copy() -> None:
    data = bytearray(b"\x01\x04\x00\x00\x00\x02\x00\x00\x00hi")
    message = protocol.parse_binary(data)
    assert isinstance(message, protocol.ClientMessageData)
    assert message.channel_id == 4
    assert bytes(message.payload) == b"\x02\x00\x00\x00hi"
    assert message.payload.obj is data
    call = protocol.parse_binary(struct.pack("<BIII", 2, 1, 12, 4) + b"ros1" + b"\x01")
    assert call == protocol.ServiceCallRequest(1, 12, "ros1", memoryview(b"\x01"))


@pytest.mark.parametrize("whole", [b"\x01\x04\x00\x00\x00", struct.pack("<BIII", 2, 1, 12, 4) + b"ros1"])
def test_a_binary_message_that_was_cut_is_refused_at_each_length(whole: bytes) -> None:
    protocol.parse_binary(whole)
    for length in range(len(whole)):
        with pytest.raises(RemoteProtocolError):
            protocol.parse_binary(whole[:length])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "junk",
        "[]",
        "{}",
        '{"op":"nonsense"}',
        '{"op":"subscribe"}',
        '{"op":"subscribe","subscriptions":[{"id":-1,"channelId":1}]}',
        '{"op":"subscribe","subscriptions":[{"id":4294967296,"channelId":1}]}',
        '{"op":"subscribe","subscriptions":[{"id":1.5,"channelId":1}]}',
        '{"op":"fetchAsset","uri":"\ud800","requestId":1}',
        '{"op":"fetchAsset","uri":"' + "x" * 2000 + '","requestId":1}',
        '{"op":"setParameters","parameters":[{"name":"/a","value":' + "[" * 100_000,
        '{"op":"setParameters","parameters":[{"name":"/a","value":1,"type":"float32"}]}',
        '{"op":"unsubscribe","subscriptionIds":[' + "1," * limits.FOXGLOVE_SUBSCRIPTIONS_MAX + "1]}",
    ],
    ids=lambda text: text[:60],
)
def test_broken_and_hostile_text_is_refused(text: str) -> None:
    with pytest.raises(RemoteProtocolError):
        protocol.parse_text(text)


def test_a_frame_beyond_the_limit_is_refused_before_it_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "FOXGLOVE_TEXT_MAX", 10)
    monkeypatch.setattr(limits, "FOXGLOVE_BINARY_MAX", 10)
    with pytest.raises(LimitExceeded):
        protocol.parse_text('{"op":"subscribeConnectionGraph"}')
    with pytest.raises(LimitExceeded):
        protocol.parse_binary(b"\x01" + bytes(10))


@pytest.mark.parametrize("data", [b"", b"\x00", b"\x09", struct.pack("<BIII", 2, 1, 1, 400) + b"ros1"])
def test_broken_binary_messages_are_refused(data: bytes) -> None:
    with pytest.raises(RemoteProtocolError):
        protocol.parse_binary(data)


def test_an_encoding_that_is_not_utf8_is_refused() -> None:
    with pytest.raises(RemoteProtocolError):
        protocol.parse_binary(struct.pack("<BIII", 2, 1, 1, 1) + b"\xff")


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**64 - 1), st.binary(max_size=64))
def test_any_message_is_framed_as_the_protocol_says(subscription: int, stamp: int, payload: bytes) -> None:
    frame = bytes(protocol.message_data(subscription, stamp, memoryview(payload)))
    assert struct.unpack_from("<BIQ", frame) == (1, subscription, stamp)
    assert frame[13:] == payload


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1), st.binary(max_size=64))
def test_a_call_and_its_response_have_the_same_layout(service: int, call: int, payload: bytes) -> None:
    frame = bytes(protocol.service_response(service, call, payload))
    read = protocol.parse_binary(b"\x02" + frame[1:])
    assert read == protocol.ServiceCallRequest(service, call, "ros1", memoryview(payload))


@given(st.text(max_size=200))
def test_any_text_of_a_status_survives_json(text: str) -> None:
    decoded = msgspec.json.decode(protocol.FoxgloveStatus(level=0, message=text).frame().data)
    assert decoded["message"] == text
