"""Fuzz target: frames of a Foxglove client, whole sessions of them, with a hub that answers everything."""

from __future__ import annotations

import struct

import msgspec

from rmpa.core.errors import RemoteProtocolError
from rmpa.web.foxglove import protocol
from rmpa.web.foxglove.session import FoxgloveSession, Output
from rmpa.web.hub import requests
from rmpa.web.hub.node_link import Rights

ALL = Rights(view=True, control=True)
SEEDS: list[bytes] = [
    b'{"op":"subscribe","subscriptions":[{"id":0,"channelId":1},{"id":1,"channelId":5}]}',
    b'{"op":"unsubscribe","subscriptionIds":[0,1]}',
    b'{"op":"advertise","channels":[{"id":1,"topic":"/foo","encoding":"ros1","schemaName":"std_msgs/String"}]}',
    b'{"op":"unadvertise","channelIds":[1,2]}',
    b'{"op":"getParameters","parameterNames":["/a","/b"],"id":"r"}',
    b'{"op":"setParameters","parameters":[{"name":"/a","value":3,"type":"float64"},{"name":"/b","value":[[1]]}]}',
    b'{"op":"setParameters","parameters":[{"name":"/c","value":"QUI=","type":"byte_array"},{"name":"/d"}]}',
    b'{"op":"subscribeParameterUpdates","parameterNames":[]}',
    b'{"op":"unsubscribeParameterUpdates","parameterNames":["/a"]}',
    b'{"op":"subscribeConnectionGraph"}',
    b'{"op":"fetchAsset","uri":"package://foo/robot.urdf","requestId":123}',
    b"\x01\x01\x00\x00\x00\x02\x00\x00\x00hi",
    struct.pack("<BIII", 2, 1, 12, 4) + b"ros1\x01",
]


def fuzz(data: bytes) -> None:
    """Each frame is refused with a status or leads to frames and requests that make sense; the session goes on."""
    for frame in (data, data.decode("utf-8", "replace")):
        try:
            protocol.parse_text(frame) if isinstance(frame, str) else protocol.parse_binary(frame)
        except RemoteProtocolError as error:
            str(error)
    session = FoxgloveSession("fuzz", "1", ALL)
    for output in session.open():
        if isinstance(output, requests.FollowGraph):
            topics = (requests.GraphTopic("/t", ("std_msgs/String",), ("/n",)),)
            services = (requests.GraphService("/s", "std_srvs/Empty", ("/n",)),)
            _hub(session, session.answer(requests.GraphChanged(output.handle, topics, services)))
    for part in data.split(b"\n")[:50]:
        _hub(session, session.receive(part, 0.0))
        _hub(session, session.receive(part.decode("utf-8", "replace"), 0.0))
    session.close()


def _hub(session: FoxgloveSession, outputs: list[Output]) -> None:
    todo = list(outputs)
    while todo:
        output = todo.pop(0)
        answer: requests.Answer
        match output:
            case protocol.TextFrame():
                msgspec.json.decode(output.data)
                continue
            case protocol.BinaryFrame():
                bytes(output)
                continue
            case requests.DescribeType():
                answer = requests.Described(output.handle, output.type, "string data", "")
            case requests.SetParam():
                answer = requests.ParamsChanged(output.handle, {output.name: output.value})
            case requests.GetParams():
                answer = requests.ParamsChanged(output.handle, {"/a": 1.0, "/b": b"x"})
            case requests.CallService():
                answer = requests.ServiceResult(output.handle, ok=True, payload=output.request)
            case requests.Subscribe():
                answer = requests.ReceivedMessage(output.handle, output.topic, "std_msgs/String", memoryview(b"1"), 1)
            case requests.PublishMessage() | requests.FetchAsset():
                answer = requests.Failed(output.handle, "cannot", "try")
            case _:
                continue
        todo += session.answer(answer)
