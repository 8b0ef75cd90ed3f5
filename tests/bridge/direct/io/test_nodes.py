"""Calls to nodes and to the kernel: whom a subscriber is connected to, and the end of that connection alone."""

from __future__ import annotations

import asyncio
import socket
from typing import TYPE_CHECKING

import pytest

from rmpa.bridge.direct.grants import end_all
from rmpa.bridge.topics.direct import bus_links, end_link, publisher_update, standing
from rmpa.ros.node.publication import Publication
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.node.subscription import Subscription
from rmpa.runtime import kernel_tcp
from rmpa.runtime.kernel_tcp import connections, may_end_connections
from tests.ros.node.peers import STRING, until
from tests.runtime.capabilities import NET_ADMIN, without

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

needs_right = pytest.mark.skipif(bool(may_end_connections()), reason="this process may not end connections")


class Pair:
    """A subscriber of /t and its publisher."""

    def __init__(self) -> None:
        self.talker = SlaveNode("/talker", "127.0.0.1", "")
        self.viewer = SlaveNode("/viewer", "127.0.0.1", "")
        self.publication = Publication("/t", "/talker", STRING)

    @property
    def endpoint(self) -> tuple[str, int]:
        found = self.talker.address_of("/t")
        assert found is not None
        return found

    @property
    def ports(self) -> set[int]:
        return standing(self.endpoint[0]).get(self.endpoint[1], set())


@pytest.fixture
async def pair() -> AsyncIterator[Pair]:
    made = Pair()
    await made.talker.start()
    await made.viewer.start()
    made.talker.add_publication(made.publication)
    made.viewer.add_subscription(Subscription("/t", "/viewer", on_message=lambda *_: None))
    assert await publisher_update(made.viewer.uri, "/t", [made.talker.uri])
    await until(lambda: made.publication.listeners)
    yield made
    await made.viewer.close()
    await made.talker.close()


async def test_a_subscriber_says_its_connection_and_the_kernel_too(pair: Pair) -> None:
    links = await bus_links(pair.viewer.uri, "/t")
    assert links is not None
    (link,) = links
    assert (link.connected, link.remote) == (True, pair.endpoint)
    assert pair.ports == {link.local_port}
    assert await bus_links(pair.viewer.uri, "/other") == []
    assert await bus_links(pair.talker.uri, "/t") == [], "its own connections are outbound"


async def test_a_node_that_does_not_answer_is_told_from_one_without_connections(pair: Pair) -> None:
    uri = pair.viewer.uri
    await pair.viewer.close()
    assert await bus_links(uri, "/t") is None
    assert not await publisher_update(uri, "/t", [])


@needs_right
async def test_the_connection_of_one_subscriber_ends_and_those_of_others_stay(pair: Pair) -> None:
    with socket.create_connection(pair.endpoint) as other:
        links = await bus_links(pair.viewer.uri, "/t")
        (mine,) = {link.local_port for link in links or ()}
        assert [await end_link(link) for link in links or ()] == [""]
        assert mine not in pair.ports
        assert other.getsockname()[1] in pair.ports, "of another program"
        assert [await end_link(link) for link in links or ()] == [""], "there is none any more"


@needs_right
async def test_a_publishers_connections_to_one_address_end(pair: Pair) -> None:
    assert end_all(connections(local_port=pair.endpoint[1], remote=("127.0.0.2", None))) == ""
    assert pair.publication.listeners == ("/viewer",)
    assert end_all(connections(local_port=pair.endpoint[1], remote=("127.0.0.1", None))) == ""
    await until(lambda: "/viewer" not in pair.publication.listeners or not pair.ports)


async def test_without_the_right_the_reason_is_told(pair: Pair, monkeypatch: pytest.MonkeyPatch) -> None:
    # As where the kernel (Yama) lets no process copy another one's descriptors.
    monkeypatch.setattr(kernel_tcp, "_disconnect", lambda _: False)
    ports = pair.ports
    assert ports
    if may_end_connections():
        problem = end_all(connections(remote=pair.endpoint))
    else:
        problem = await asyncio.to_thread(without, NET_ADMIN, lambda: end_all(connections(remote=pair.endpoint)))
    assert "not permitted" in problem
    assert pair.ports == ports
