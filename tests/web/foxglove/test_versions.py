"""Foxglove channels of a topic whose publishers have different versions of one type."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from rmpa.ros.types.definitions import parse_definition
from rmpa.ros.types.messages import MessageType
from rmpa.web.hub import requests
from tests.web.foxglove.client import CHATTER, Client, message
from tests.web.gateways.server import running_server
from tests.web.hub.client import local_core, node

if TYPE_CHECKING:
    from typing import Any


def test_publishers_with_two_versions_of_a_type_are_two_channels_and_the_client_is_warned() -> None:
    client = Client()
    client.graph(CHATTER)
    own, other = MessageType("std_msgs/String").md5sum, "5" * 32
    handle = client.subscribe(1)
    client.hub(message(handle, "/chatter", b"ours", md5sum=own))
    client.hub(message(handle, "/chatter", b"other", md5sum=other))
    client.hub(message(handle, "/chatter", b"ours again", md5sum=own))
    client.hub(message(handle, "/chatter", b"other again", md5sum=other))
    assert len(client.frames) == 2, "a message of the other version was sent on a channel with another schema"
    (second,) = client.of("advertise")[-1]["channels"]
    assert (second["topic"], second["schemaName"], second["id"]) == ("/chatter", "std_msgs/String", 2)
    assert other in second["schema"]
    (warned,) = client.of("status")
    assert warned["level"] == 1
    assert own in warned["message"]
    assert other in warned["message"]
    assert not client.of("unadvertise")
    further = client.subscribe(2, number=8)
    client.hub(message(further, "/chatter", b"ours", md5sum=own))
    client.hub(message(further, "/chatter", b"other", md5sum=other))
    assert len(client.frames) == 3
    client.graph()
    assert sorted(client.of("unadvertise")[-1]["channelIds"]) == [1, 2]
    assert client.of("removeStatus")[-1]["statusIds"] == [warned["id"]]


def test_a_channel_whose_version_no_publisher_has_is_replaced() -> None:
    client = Client()
    client.graph(CHATTER)
    other = "5" * 32
    handle = client.subscribe(1)
    client.hub(message(handle, "/chatter", b"other", md5sum=other))
    assert client.of("unadvertise")[-1]["channelIds"] == [1]
    assert client.last(requests.Unsubscribe).handle == handle
    (second,) = client.of("advertise")[-1]["channels"]
    assert other in second["schema"]
    assert not client.of("status")
    further = client.subscribe(second["id"])
    client.hub(message(further, "/chatter", b"other", md5sum=other))
    assert len(client.frames) == 1
    client.graph(CHATTER)
    assert client.of("unadvertise")[-1]["channelIds"] == [1], "the channel of the version was withdrawn again"


async def test_a_client_reads_the_messages_of_each_publisher_by_its_own_schema() -> None:
    old, new = (
        MessageType("my_msgs/Pair", parse_definition("my_msgs/Pair", text)) for text in ("float64 a", "int32 b")
    )
    async with (
        local_core() as core,
        running_server(core) as server,
        node(core, "one") as one,
        node(core, "two") as two,
        server.client("foxglove.websocket.v1") as client,
    ):
        (await one.advertise("/pair", old, latch=True)).publish_raw(struct.pack("<d", 2.5))
        channels: dict[int, dict[str, Any]] = {}
        read: dict[str, bytes] = {}
        told = iter(range(1, 100))

        async def subscribe_next() -> None:
            """Subscribe to the next channel of the topic that is advertised, and take its first message."""
            while True:
                for channel in (await client.next("advertise"))["channels"]:
                    if channel["topic"] == "/pair":
                        number = next(told)
                        channels[number] = channel
                        await client.send("subscribe", subscriptions=[{"id": number, "channelId": channel["id"]}])
                        data = await client.next_bytes()
                        _, subscription, _ = struct.unpack_from("<BIQ", data)
                        read[channels[subscription]["schema"].strip()] = data[13:]
                        return

        await subscribe_next()
        (await two.advertise("/pair", new, latch=True)).publish_raw(struct.pack("<i", 7))
        while "2 versions of my_msgs/Pair" not in (await client.next("status"))["message"]:
            pass
        await subscribe_next()
        assert read == {"float64 a": struct.pack("<d", 2.5), "int32 b": struct.pack("<i", 7)}
