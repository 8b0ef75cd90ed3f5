"""Foxglove channels of a topic whose publishers have different versions of one type."""

from __future__ import annotations

import pytest

from rmpa.ros.types.definitions import parse_definition
from rmpa.ros.types.messages import MessageType
from tests.web.foxglove.client import CHATTER, Client

OWN = MessageType("std_msgs/String").md5sum
OTHER = MessageType("std_msgs/String", parse_definition("std_msgs/String", "int32 other"))


@pytest.fixture
def client() -> Client:
    """A client of a hub that has another version of the type, too."""
    client = Client()
    client.hub.types.versions[OTHER.md5sum] = OTHER
    client.graph(CHATTER)
    return client


def test_publishers_with_two_versions_of_a_type_are_two_channels_and_all_clients_are_warned(client: Client) -> None:
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


def test_a_channel_whose_version_no_publisher_has_is_replaced(client: Client) -> None:
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
