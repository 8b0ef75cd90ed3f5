"""Many nodes at one pair of listening sockets: each is reached at its own address, and only from this machine."""

from __future__ import annotations

import asyncio
import errno
import socket
from typing import TYPE_CHECKING

import psutil
import pytest

from rmpa.core.counters import Counters
from rmpa.core.errors import StartError, UnreachableError
from rmpa.ros import limits
from rmpa.ros.core.liveness import name_at
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node import listeners as shared_listener
from rmpa.ros.node.listeners import SharedListener
from rmpa.ros.node.publication import Publication
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.runtime.accept import Acceptor
from tests.ros.node.peers import STRING, RawSubscriber, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.ros.wire.xmlrpc import XmlRpcValue

SALT = "http://127.0.0.1:11311/"


@pytest.fixture
async def listener() -> AsyncIterator[SharedListener]:
    made = SharedListener(SALT, counters=Counters())
    await made.start()
    yield made
    await made.close()


async def node(listener: SharedListener, name: str) -> SlaveNode:
    """A node that publishes /t at the listener."""
    made = SlaveNode(name, "127.0.0.1", SALT, listener=listener)
    await made.start()
    made.add_publication(Publication("/t", name, STRING))
    return made


def listening() -> int:
    """How many sockets of this process listen."""
    return sum(found.status == psutil.CONN_LISTEN for found in psutil.Process().net_connections("tcp"))


async def connect(address: tuple[str, int]) -> str:
    """Subscribe to /t at an address; who answers."""
    link = await RawSubscriber.connect(address)
    try:
        return (await link.header())["callerid"]
    finally:
        link.close()


async def request_topic(uri: str) -> XmlRpcValue:
    """Where a node says that /t is to be had."""
    reply = await call_api(uri, "requestTopic", "/s", "/t", [["TCPROS"]])
    return [reply.code, reply.value]


async def test_each_of_many_nodes_is_reached_at_its_own_address(listener: SharedListener) -> None:
    before = listening()
    nodes = [await node(listener, f"/n{number}") for number in range(100)]
    assert listening() == before
    assert len(listener._nodes) == len({one.uri for one in nodes}) == 100
    for one in nodes:
        address = one.address_of("/t")
        assert address is not None
        assert one.uri == f"http://{address[0]}:{listener.ports[0]}/"
        assert one.service_uri == f"rosrpc://{address[0]}:{listener.ports[1]}"
        assert (await call_api(one.uri, "getName", "/s")).value == one.name
        assert await request_topic(one.uri) == [1, ["TCPROS", *address]]
        assert await connect(address) == one.name
    for one in nodes:
        await one.close()
    assert len(listener._nodes) == 0


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
    await second.close()


async def test_open_connections_end_with_their_node_and_no_other(listener: SharedListener) -> None:
    one, other = await node(listener, "/one"), await node(listener, "/other")
    links = []
    for made in (one, other):
        address = made.address_of("/t")
        assert address is not None
        links.append(await RawSubscriber.connect(address))
        await links[-1].header()
    await one.close()
    assert await links[0].ended()
    other._publications["/t"].publish_framed(b"\x02\0\0\0hi")
    assert await links[1].message() == b"hi"
    for link in links:
        link.close()
    await other.close()


async def test_other_addresses_of_this_machine_are_no_nodes(listener: SharedListener) -> None:
    made = await node(listener, "/n")
    assert await request_topic(f"http://127.0.0.1:{listener.ports[0]}/") == [-1, 0]
    await made.close()


async def test_a_burst_of_connections_is_accepted(listener: SharedListener) -> None:
    nodes = [await node(listener, f"/n{number}") for number in range(20)]
    addresses = [address for one in nodes if (address := one.address_of("/t"))]
    found = await asyncio.gather(*(connect(address) for address in addresses for _ in range(10)))
    assert found == [one.name for one in nodes for _ in range(10)]
    await asyncio.gather(*(one.close() for one in nodes))


async def test_a_call_under_way_when_its_node_closes_is_not_left_open(listener: SharedListener) -> None:
    made = await node(listener, "/n")
    link = await RawSubscriber.dial((made.uri.split("/")[2].split(":")[0], listener.ports[0]))
    await until(lambda: made._http._arriving or made._http._connections)
    await made.close()
    assert await link.ended()
    link.close()


async def test_missing_right_to_bind_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    class Forbidden(socket.socket):
        def setsockopt(self, level: int, option: int, value: int | bytes) -> None:  # type: ignore[override]
            if option == socket.SO_BINDTODEVICE:
                raise PermissionError(errno.EPERM, "Operation not permitted")
            super().setsockopt(level, option, value)

    monkeypatch.setattr(socket, "socket", Forbidden)
    with pytest.raises(StartError, match="one listening socket for all proxies: Operation not permitted"):
        await SharedListener(SALT).start()


async def test_missing_device_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_listener, "_DEVICE", b"no_such_device")
    with pytest.raises(StartError, match="No such device"):
        await SharedListener(SALT).start()


async def test_addresses_that_lead_nowhere_are_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SHARED_PROBE_TIMEOUT", 0.05)

    def deaf(sock: socket.socket, _on_accept: object, *, name: str) -> Acceptor:
        return Acceptor(sock, lambda accepted, _client: accepted.close(), name=name)

    monkeypatch.setattr(shared_listener, "Acceptor", deaf)
    with pytest.raises(StartError, match=r"a connection to 127\.[0-9.]+ on this machine does not arrive"):
        await SharedListener(SALT).start()
