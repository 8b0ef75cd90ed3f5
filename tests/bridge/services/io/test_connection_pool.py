"""The connections to one server: calls at once, each over its own, and no call lost with one that was closed."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from rmpa.bridge import limits
from rmpa.bridge.services.bodies import LocalService, ServicePool
from rmpa.core.errors import RmpaError
from rmpa.ros.node.service_server import ServiceCall, ServiceEndpoint
from rmpa.ros.node.slave_node import SlaveNode
from rmpa.ros.wire.tcpros import ServiceDescription

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.runtime.tls import Buffer

MD5 = "6a2e34150c00229791cc89ff309fff21"


class Desk:
    """A server whose calls wait to be answered, and a pool for it."""

    def __init__(self, node: SlaveNode) -> None:
        self.node = node
        self.calls: list[ServiceCall] = []
        self.lost = 0
        self.endpoint = ServiceEndpoint(
            "/add", "/adder", self.calls.append, description=ServiceDescription("a/Add", MD5), timeout=30.0
        )
        node.add_service(self.endpoint)
        self.pool = ServicePool("/add", LocalService("/adder", node.service_uri), self._lost)
        self.answers: dict[bytes, tuple[bool, bytes]] = {}

    def _lost(self) -> None:
        self.lost += 1

    def call(self, body: bytes, timeout: float = 20.0) -> None:
        def done(ok: bool, answer: Buffer) -> None:
            assert body not in self.answers
            self.answers[body] = ok, bytes(answer)

        self.pool.call(body, timeout, done)

    async def until(self, *, calls: int = 0, answers: int = 0, lost: int = 0) -> None:
        async with asyncio.timeout(20):
            while len(self.calls) < calls or len(self.answers) < answers or self.lost < lost:
                await asyncio.sleep(0.001)


@pytest.fixture
async def desk() -> AsyncIterator[Desk]:
    node = SlaveNode("/adder", "127.0.0.1", "http://127.0.0.1:1/")
    await node.start()
    made = Desk(node)
    yield made
    made.pool.close("the test ends")
    await made.pool.closed()
    await node.close()


async def test_the_server_says_what_it_is_and_its_connection_stays_for_a_call(desk: Desk) -> None:
    told = await desk.pool.describe()
    assert (told.type, told.md5sum) == ("a/Add", MD5)
    desk.call(b"1")
    await desk.until(calls=1)
    assert desk.pool.size == len(desk.endpoint._clients) == 1
    desk.calls[0].reply(True, b"one")
    await desk.until(answers=1)
    desk.call(b"2")
    await desk.until(calls=2)
    assert len(desk.endpoint._clients) == 1, "an idle connection is used again"
    desk.calls[1].fail("it sticks")
    await desk.until(answers=2)
    assert desk.answers == {b"1": (True, b"one"), b"2": (False, b"it sticks")}


async def test_calls_are_made_at_once_as_far_as_may_be_and_the_rest_waits(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "SERVICE_POOL", 3)
    monkeypatch.setattr(limits, "SERVICE_QUEUE", 4)
    for number in range(6):
        desk.call(b"%d" % number)
        if number == 2:
            await desk.until(calls=3)
    assert len(desk.calls) == desk.pool.size == 3
    for number in (6, 7):
        desk.call(b"%d" % number)
    assert b"calls wait for its server already" in desk.answers[b"7"][1]
    for number in range(7):
        await desk.until(calls=number + 1)
        desk.calls[number].reply(True, desk.calls[number].request)
    await desk.until(answers=8)
    assert sum(ok for ok, _ in desk.answers.values()) == 7


async def test_a_connection_that_the_server_closed_meanwhile_is_replaced(desk: Desk) -> None:
    await desk.pool.describe()
    desk.endpoint.withdraw()
    desk.node.remove_service("/add")
    desk.node.add_service(
        ServiceEndpoint("/add", "/adder", desk.calls.append, description=ServiceDescription("a/Add", MD5))
    )
    desk.call(b"1")
    await desk.until(calls=1)
    desk.calls[0].reply(True, b"one")
    await desk.until(answers=1)
    assert desk.answers[b"1"] == (True, b"one")
    desk.node.remove_service("/add")


async def test_a_server_that_dies_in_the_middle_of_a_call(desk: Desk) -> None:
    desk.call(b"1")
    await desk.until(calls=1)
    for session in tuple(desk.endpoint._clients):
        session.close()
    await desk.until(answers=1, lost=1)
    ok, text = desk.answers[b"1"]
    assert not ok
    assert b"in the middle of the call" in text


async def test_a_server_that_is_not_there(desk: Desk) -> None:
    port = desk.node.service_uri.rpartition(":")[2]
    await desk.node.close()
    for body in (b"1", b"2"):
        desk.call(body)
    await desk.until(answers=2, lost=1)
    assert all(not ok and port.encode() in text for ok, text in desk.answers.values())
    with pytest.raises(RmpaError):
        await desk.pool.describe()


async def test_a_call_whose_time_is_over_costs_its_connection(desk: Desk) -> None:
    desk.call(b"1", timeout=0.05)
    await desk.until(calls=1, answers=1)
    assert b"no answer within" in desk.answers[b"1"][1]
    assert desk.pool.size == 0


async def test_what_nobody_uses_is_closed(desk: Desk) -> None:
    await desk.pool.describe()
    now = asyncio.get_running_loop().time()
    desk.pool.close_idle(now - 10)
    assert not desk.pool.unused
    desk.pool.close_idle(now + 10)
    assert desk.pool.unused


async def test_the_end_answers_everybody(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SERVICE_POOL", 1)
    for body in (b"1", b"2"):
        desk.call(body)
    await desk.until(calls=1)
    desk.pool.close("its server has gone")
    await desk.until(answers=2)
    assert b"its server has gone" in desk.answers[b"2"][1]
    assert not desk.answers[b"1"][0]
