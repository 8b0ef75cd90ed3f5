"""Fuzz target: frames of a Foxglove client, whole sessions of them, with a hub that answers everything."""

from __future__ import annotations

import contextlib
import struct

from rmpa.core.errors import RemoteProtocolError
from rmpa.web.foxglove import protocol
from rmpa.web.foxglove.session import DECODER
from rmpa.web.hub.graph import GraphService, GraphTopic
from tests.web.foxglove.client import Client
from tests.web.recorder import answer

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
        with contextlib.suppress(RemoteProtocolError):
            protocol.parse_text(frame, DECODER) if isinstance(frame, str) else protocol.parse_binary(frame)
    client = Client()
    client.graph(GraphTopic("/t", ("std_msgs/String",), ("/n",)), GraphService("/s", "std_srvs/Empty", ("/n",)))
    for part in data.split(b"\n")[:50]:
        for each in (part, part.decode("utf-8", "replace")):
            for asked in client.send_raw(each):
                answer(asked, part)
    assert all("op" in each for each in client.json)
    client.session.closing()
