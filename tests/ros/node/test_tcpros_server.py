from __future__ import annotations

import logging
import socket
import struct
from collections.abc import AsyncIterator
from ipaddress import IPv4Address, IPv4Network

import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import StartError, UnreachableError
from rmpa.core.statistics import Counters
from rmpa.ros import limits
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node import listeners as shared_listener
from rmpa.ros.node.ask import name_at
from rmpa.ros.node.listeners import SharedListener, loopback_addresses
from rmpa.ros.node.publication import Publication
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.wire.tcpros import encode_header, frame_message
from rmpa.ros.wire.xmlrpc import XmlRpcValue
from rmpa.runtime.accept import Acceptor
from tests.ros.node.peers import STRING, RawSubscriber
from tests.waiting import until


class Served:
    """A node that publishes /t."""

    def __init__(self) -> None:
        self.counters = Counters()
        self.publication = Publication("/t", "/p", STRING)
        self.node = SlaveNode("/p", "127.0.0.1", "", counters=self.counters)
        self.node.add_publication(self.publication)

    @property
    def address(self) -> tuple[str, int]:
        return "127.0.0.1", self.node._tcpros_port


@pytest.fixture
async def served() -> AsyncIterator[Served]:
    made = Served()
    await made.node.start()
    yield made
    await made.node.close()


@pytest.mark.trap(7)
async def test_a_header_may_come_byte_by_byte(served: Served) -> None:
    link = await RawSubscriber.dial(served.address)
    for byte in encode_header({"topic": "/t", "callerid": "/s", "md5sum": "*"}):
        await link.send(bytes([byte]))
    assert (await link.header())["callerid"] == "/p"


@pytest.mark.trap(4, 5, 23)
@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"topic": "/other"}, "[/p] is not a publisher of [/other]"),
        ({"topic": "", "service": "/add"}, "[/p] does not offer the service [/add]"),
        ({"topic": ""}, "neither a 'topic' nor a 'service' field in the connection header"),
        ({"callerid": ""}, "required field 'callerid' is missing in the connection header"),
    ],
)
async def test_what_is_refused(served: Served, fields: dict[str, str], error: str) -> None:
    link = await RawSubscriber.connect(served.address, buffer=0, **fields)
    assert await link.header() == {"error": error}
    assert await link.ended()


@pytest.mark.trap(6, 7)
@pytest.mark.parametrize(
    "data",
    [
        b"GET / HTTP/1.1\r\n\r\n", struct.pack("<II", 4, 0), struct.pack("<II", 9, 5) + b"topic",
        struct.pack("<II", 12, 900) + b"topic=/t", b"\xff" * 64,
    ],
)  # fmt: skip
async def test_malformed_headers_are_counted_and_closed(
    served: Served, data: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    link = await RawSubscriber.dial(served.address)
    await link.send(data)
    assert await link.ended()
    await until(lambda: served.counters["tcpros.refused.malformed"] == 1)
    assert "a connection from 127.0.0.1" in caplog.text


@pytest.mark.trap(7)
async def test_an_empty_header_is_refused_instead_of_held(served: Served) -> None:
    link = await RawSubscriber.dial(served.address)
    await link.send(bytes(4))
    assert "error" in await link.header()


@pytest.mark.trap("16a")
async def test_leaving_before_the_header_is_no_error(served: Served, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    for data in (b"", b"\x10\x00"):
        link = await RawSubscriber.dial(served.address)
        await link.send(data)
        link.close()
    patient = await RawSubscriber.connect(served.address)
    assert "error" not in await patient.header(), "those before it have been accepted"
    await until(lambda: not served.node._greetings)
    assert served.counters.as_dict() == {}
    assert caplog.text == ""


@pytest.mark.trap(6, 11, 18)
async def test_silent_connection_blocks_no_other_and_is_closed(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "TCPROS_HANDSHAKE_TIMEOUT", 0.2)
    silent = await RawSubscriber.dial(served.address)
    other = await RawSubscriber.connect(served.address)
    assert "error" not in await other.header()
    assert await silent.ended()
    assert served.counters["tcpros.refused.silent"] == 1
    assert served.publication.subscribers == 1


async def test_a_connection_that_its_topic_cannot_take_is_closed(
    served: Served, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fails(_connection: object) -> None:
        raise RuntimeError("a callback fails")

    monkeypatch.setattr(served.publication, "attach", fails)
    link = await RawSubscriber.connect(served.address)
    assert await link.ended()
    assert "a callback fails" in caplog.text


async def test_connections_without_a_header_are_bounded(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "TCPROS_HANDSHAKES_MAX", 3)
    links = [await RawSubscriber.dial(served.address) for _ in range(4)]
    assert await links[3].ended()
    assert served.counters["tcpros.refused.full"] == 1
    for link in links:
        link.close()
    await until(lambda: not served.node._greetings)


async def test_all_connections_are_bounded_and_closed_ones_do_not_count(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "TCPROS_CONNECTIONS_MAX", 3)
    for _ in range(2):
        links = [await RawSubscriber.connect(served.address) for _ in range(3)]
        for link in links:
            await link.header()
        surplus = await RawSubscriber.connect(served.address)
        assert await surplus.ended()
        for link in (*links, surplus):
            link.close()
        await until(lambda: served.publication.subscribers == 0)
    assert served.counters["tcpros.refused.full"] == 2


@pytest.mark.trap(3)
@pytest.mark.parametrize("definition", ["", "another text\n", "string data\n"])
async def test_a_subscriber_may_or_may_not_send_its_definition(served: Served, definition: str) -> None:
    link = await RawSubscriber.connect(served.address, message_definition=definition)
    assert (await link.header())["message_definition"] == "string data\n"


@pytest.mark.trap(8)
async def test_what_comes_in_one_segment_with_the_header_does_no_harm(served: Served) -> None:
    link = await RawSubscriber.dial(served.address)
    header = encode_header({"topic": "/t", "callerid": "/s", "md5sum": "*"})
    await link.send(header + b"a request that should have waited for the reply")
    assert (await link.header())["callerid"] == "/p"
    served.publication.publish_framed(frame_message(b"served"))
    assert await link.message() == b"served"


@pytest.mark.trap(23)
async def test_a_probe_for_a_service_that_is_gone_is_answered_and_not_logged(
    served: Served, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    probe = {"topic": "", "service": "/add", "probe": "1"}
    for _ in range(5):
        hasty = await RawSubscriber.connect(served.address, buffer=0, **probe)
        hasty.close()  # wait_for_service does not read the reply
    patient = await RawSubscriber.connect(served.address, buffer=0, **probe)
    assert await patient.header() == {"error": "[/p] does not offer the service [/add]"}
    assert await patient.ended()
    await until(lambda: not served.node._greetings)
    assert served.counters.as_dict() == {}
    assert caplog.records == []


# Many nodes at one pair of listening sockets: each is reached at its own address, and only from this machine.


SALT = "http://127.0.0.1:11311/"


@pytest.fixture
async def listener() -> AsyncIterator[SharedListener]:
    made = SharedListener(SALT, counters=Counters())
    await made.start()
    yield made
    while NODES:
        await NODES.pop().close()
    await made.close()


NODES: list[SlaveNode] = []


async def node(listener: SharedListener, name: str) -> SlaveNode:
    """A node that publishes /t at the listener, and ends with it."""
    NODES.append(SlaveNode(name, "127.0.0.1", SALT, listener=listener))
    await NODES[-1].start()
    NODES[-1].add_publication(Publication("/t", name, STRING))
    return NODES[-1]


def listening() -> int:
    """How many sockets of this process listen."""
    return sum(found.status == psutil.CONN_LISTEN for found in psutil.Process().net_connections("tcp"))


async def connect(address: tuple[str, int]) -> str:
    """Subscribe to /t at an address; who answers."""
    return (await (await RawSubscriber.connect(address)).header())["callerid"]


async def request_topic(uri: str) -> XmlRpcValue:
    """Where a node says that /t is to be had."""
    reply = await call_api(uri, "requestTopic", "/s", "/t", [["TCPROS"]])
    return [reply.code, reply.value]


async def test_the_address_of_a_closed_node_is_refused_and_not_given_again(listener: SharedListener) -> None:
    counters = listener._counters
    first = await node(listener, "/n")
    uri, address = first.uri, first.address_of("/t")
    assert address is not None
    await first.close()
    second = await node(listener, "/n")
    await first.close()
    assert second.uri != uri
    assert await request_topic(uri) == [-1, 0], "rospy tries again for ever where a call is not answered"
    for method, *rest in (("getPid",), ("shutdown", "user request"), ("getBusInfo",)):
        with pytest.raises(UnreachableError, match="Connection reset by peer"):
            await call_api(uri, method, "/rosnode", *rest)
    assert await name_at(uri) is None, "an agent's leftovers at a roscore are told from a live agent's nodes"
    with pytest.raises(ConnectionResetError):
        await connect(address)
    assert counters["address.unknown.xmlrpc"] >= 2
    assert counters["address.unknown.tcpros"] == 1
    assert (await call_api(second.uri, "getName", "/s")).value == "/n"


async def test_other_addresses_of_this_machine_are_no_nodes(listener: SharedListener) -> None:
    await node(listener, "/n")
    assert await request_topic(f"http://127.0.0.1:{listener.ports[0]}/") == [-1, 0]


async def test_missing_device_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_listener, "_DEVICE", b"no_such_device")
    with pytest.raises(StartError, match="No such device"):
        await SharedListener(SALT).start()


async def test_addresses_that_lead_nowhere_are_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rmpa.ros.node.listeners.SHARED_PROBE_TIMEOUT", 0.05)

    def deaf(sock: socket.socket, _on_accept: object, *, name: str) -> Acceptor:
        return Acceptor(sock, lambda accepted, _client: accepted.close(), name=name)

    monkeypatch.setattr(shared_listener, "Acceptor", deaf)
    with pytest.raises(StartError, match=r"a connection to 127\.[0-9.]+ on this machine does not arrive"):
        await SharedListener(SALT).start()


RESERVED = [IPv4Network("127.0.0.0/16"), IPv4Network("127.255.0.0/16")]


def attached(listener: SharedListener, name: str) -> str:
    """A node's address; nothing takes its connections."""
    return listener.attach(name, lambda *_: None, lambda *_: None)


async def test_ten_thousand_nodes_have_addresses_of_their_own() -> None:
    listener = SharedListener(SALT)
    assert len({attached(listener, f"/rmpa/base/node_{n}") for n in range(10_000)}) == 10_000


@given(st.text())
def test_no_address_is_special(name: str) -> None:
    address = IPv4Address(next(loopback_addresses(SALT, name)))
    assert address in IPv4Network("127.0.0.0/8")
    assert not any(address in network for network in RESERVED)
    assert address.packed[3] not in {0, 255}


async def test_a_freed_address_rests(monkeypatch: pytest.MonkeyPatch) -> None:
    listener = SharedListener(SALT)
    listener.detach("127.1.2.3")
    first = attached(listener, "/n")
    listener.detach(first)
    listener.detach(first)
    second = attached(listener, "/n")
    assert second != first
    listener.detach(second)
    monkeypatch.setattr(shared_listener, "LOOPBACK_REST", 0.0)
    assert attached(listener, "/n") == first


async def test_of_too_many_resting_addresses_the_oldest_may_be_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "LOOPBACK_RESTING_MAX", 2)
    listener = SharedListener(SALT)
    taken = [attached(listener, f"/n{n}") for n in range(3)]
    for address in taken:
        listener.detach(address)
    assert attached(listener, "/n0") == taken[0]
    assert attached(listener, "/n1") != taken[1]
