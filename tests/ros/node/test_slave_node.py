from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from rmpa.core.errors import StartError
from rmpa.ros.http.rpc import call_api
from rmpa.ros.node.publication import Publication, PublicationEvents
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.wire.xmlrpc import RosReply
from tests.ros.node.peers import STRING, RawSubscriber, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable


@pytest.fixture
async def node() -> AsyncIterator[SlaveNode]:
    made = SlaveNode("/p", "127.0.0.1", "http://127.0.0.1:11311/")
    await made.start()
    yield made
    await made.close()


async def test_the_uri_bears_the_advertised_host() -> None:
    node = SlaveNode("/p", "127.0.0.1", "", advertised_host="robot.local")
    await node.start()
    node.add_publication(Publication("/t", "/p", STRING))
    assert node.uri.startswith("http://robot.local:")
    assert node.uri.endswith("/")
    assert node.address_of("/t") == ("robot.local", node._tcpros.address[1])
    await node.close()


async def test_a_removed_topic_is_closed_and_unknown(node: SlaveNode) -> None:
    node.add_publication(Publication("/t", "/p", STRING))
    link = await RawSubscriber.connect(node._tcpros.address)
    await link.header()
    node.remove_publication("/t")
    node.remove_publication("/t")
    assert await link.ended()
    assert (await call_api(node.uri, "requestTopic", "/s", "/t", [["TCPROS"]])).code == -1


async def test_a_port_in_use_is_a_clear_error_and_leaves_nothing_open(node: SlaveNode) -> None:
    port = int(node.uri.rsplit(":", 1)[1].strip("/"))
    with pytest.raises(StartError, match=f"port {port} is already in use"):
        await SlaveNode("/q", "127.0.0.1", "", port=port).start()


class Asked(PublicationEvents):
    """Lets a function answer ``requestTopic``."""

    def __init__(self, answer: Callable[[str], Awaitable[RosReply | None] | None]) -> None:
        self.answer = answer

    def request(self, caller: str) -> Awaitable[RosReply | None] | None:
        return self.answer(caller)


@pytest.mark.parametrize("other", [RosReply(1, "there", ["TCPROS", "10.0.0.1", 45225]), RosReply(0, "no", []), None])
@pytest.mark.trap(42)
async def test_the_answer_to_request_topic_may_take_its_time(node: SlaveNode, other: RosReply | None) -> None:
    asked: list[str] = []
    known = asyncio.Event()

    async def decide() -> RosReply | None:
        await known.wait()
        return other

    def request(caller: str) -> Awaitable[RosReply | None] | None:
        asked.append(caller)
        return None if caller == "/plain" else decide()

    node.add_publication(Publication("/t", "/p", STRING, events=Asked(request)))
    own = await call_api(node.uri, "requestTopic", "/plain", "/t", [["TCPROS"]])
    waiting = asyncio.create_task(call_api(node.uri, "requestTopic", "/viewer", "/t", [["TCPROS"]]))
    await until(lambda: "/viewer" in asked)
    # Meanwhile the node answers others.
    assert await call_api(node.uri, "requestTopic", "/plain", "/t", [["TCPROS"]]) == own
    known.set()
    assert await waiting == (own if other is None else other)
    # Topics that it does not have are not asked about.
    assert (await call_api(node.uri, "requestTopic", "/viewer", "/none", [["TCPROS"]])).code != 1
    assert asked == ["/plain", "/viewer", "/plain"]


async def test_a_caller_that_leaves_while_it_waits_ends_the_wait(node: SlaveNode) -> None:
    ended = asyncio.Event()
    begun = asyncio.Event()

    async def decide() -> RosReply | None:
        begun.set()
        try:
            await asyncio.Event().wait()
        finally:
            ended.set()
        return None

    node.add_publication(Publication("/t", "/p", STRING, events=Asked(lambda _: decide())))
    waiting = asyncio.create_task(call_api(node.uri, "requestTopic", "/s", "/t", [["TCPROS"]]))
    async with asyncio.timeout(20.0):
        await begun.wait()
        waiting.cancel()
        await node.close()
        await ended.wait()
