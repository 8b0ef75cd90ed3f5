"""Foxglove channels of a topic whose publishers have different versions of one type."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from rmpa.ros.types.definitions import parse_definition
from rmpa.ros.types.messages import MessageType
from tests.web.foxglove.client import CHATTER, Client
from tests.web.gateways.server import running_server
from tests.web.hub.client import local_core, node

if TYPE_CHECKING:
    from typing import Any

OWN = MessageType("std_msgs/String").md5sum
OTHER = MessageType("std_msgs/String", parse_definition("std_msgs/String", "int32 other"))


def _client() -> Client:
    """A client of a hub that has another version of the type, too."""
    client = Client()
    client.hub.types.versions[OTHER.md5sum] = OTHER
    client.graph(CHATTER)
    return client


def test_publishers_with_two_versions_of_a_type_are_two_channels_and_all_clients_are_warned() -> None:
    client = _client()
    beside = Client(beside=client)
    asked = client.subscribe(1)
    for md5sum in (OWN, OTHER.md5sum, OWN, OTHER.md5sum):
        asked.message(b"x", md5sum=md5sum)
    assert len(client.binary) == 2, "a message of the other version was sent on a channel with another schema"
    (second,) = client.of("advertise")[-1]["channels"]
    assert (second["topic"], second["schemaName"], second["id"]) == ("/chatter", "std_msgs/String", 2)
    assert "int32 other" in second["schema"]
    assert beside.of("advertise")[-1]["channels"] == [second]
    (warned,) = client.of("status")
    assert warned["level"] == 1
    assert OWN in warned["message"]
    assert OTHER.md5sum in warned["message"]
    assert [warned] == beside.of("status") == Client(beside=client).of("status")
    assert not client.of("unadvertise")
    further = client.subscribe(2, number=8)
    further.message(b"ours", md5sum=OWN)
    further.message(b"other", md5sum=OTHER.md5sum)
    assert len(client.binary) == 3
    client.graph()
    assert sorted(client.of("unadvertise")[-1]["channelIds"]) == [1, 2]
    assert client.of("removeStatus")[-1]["statusIds"] == [warned["id"]]


def test_a_channel_whose_version_no_publisher_has_is_replaced() -> None:
    client = _client()
    asked = client.subscribe(1)
    asked.message(b"other", md5sum=OTHER.md5sum)
    assert client.of("unadvertise")[-1]["channelIds"] == [1]
    assert asked.closed
    (second,) = client.of("advertise")[-1]["channels"]
    assert "int32 other" in second["schema"]
    assert not client.of("status")
    client.subscribe(second["id"]).message(b"other", md5sum=OTHER.md5sum)
    assert len(client.binary) == 1
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
