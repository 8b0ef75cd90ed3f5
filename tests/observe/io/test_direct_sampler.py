"""The figures of direct connections, from real nodes; they are asked only while somebody looks."""

from __future__ import annotations

import asyncio
import socket
from contextlib import AsyncExitStack, asynccontextmanager
from functools import partial
from typing import TYPE_CHECKING

import pytest

from rmpa.observe import limits
from rmpa.observe.io import direct_sampler
from rmpa.observe.io.direct_sampler import DirectFlow, DirectSampler
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.http.client import call, call_api
from rmpa.ros.node.node import Node
from rmpa.ros.wire.xmlrpc import RosFault

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.ros.wire.xmlrpc import XmlRpcValue

DEADLINE = 20.0
RATE = 100.0
MESSAGE = 4 + 4 + len("hello")
"""Bytes of a message, with its length in front."""


class Calls:
    """Counts the questions to nodes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.methods: list[str] = []
        self.stats: XmlRpcValue | RosFault | None = None
        monkeypatch.setattr(direct_sampler, "call", self)

    async def __call__(self, uri: str, method: str, *params: XmlRpcValue, timeout: float) -> XmlRpcValue:
        self.methods.append(method)
        if method == "getBusStats" and self.stats is not None:
            if isinstance(self.stats, RosFault):
                raise self.stats
            return self.stats
        return await call(uri, method, *params, timeout=timeout)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    return Calls(monkeypatch)


@asynccontextmanager
async def pair() -> AsyncIterator[tuple[DirectFlow, DirectFlow]]:
    """A publisher with a subscriber; the flow as each of the two nodes has it."""
    async with AsyncExitStack() as stack:
        core = RosCore(port=0)
        await core.start()
        stack.push_async_callback(core.close)
        talker = await stack.enter_async_context(Node("/talker", master_uri=core.uri))
        viewer = await stack.enter_async_context(Node("/viewer", master_uri=core.uri))
        publisher = await talker.advertise("/cmd", "std_msgs/String")
        await viewer.subscribe("/cmd", "std_msgs/String", lambda _: None)
        async with asyncio.timeout(DEADLINE):
            while not publisher.subscribers:
                await asyncio.sleep(0.005)

        async def talk() -> None:
            while True:
                publisher.publish(publisher.make({"data": "hello"}))
                await asyncio.sleep(1 / RATE)

        talking = asyncio.create_task(talk())
        stack.callback(talking.cancel)
        reply = await call_api(talker.uri, "requestTopic", "/viewer", "/cmd", [["TCPROS"]])
        assert isinstance(reply.value, list)
        _, host, port = reply.value
        assert isinstance(host, str)
        assert isinstance(port, int)
        yield (
            DirectFlow("/viewer", viewer.uri, "/cmd", "/viewer", (host, port)),
            DirectFlow("/talker", talker.uri, "/cmd", "/viewer"),
        )


@asynccontextmanager
async def sampling(*flows: DirectFlow) -> AsyncIterator[DirectSampler]:
    sampler = DirectSampler(lambda topics: [flow for flow in flows if topics is None or flow.topic in topics])
    yield sampler
    await sampler.close()


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(DEADLINE):
        while not condition():
            await asyncio.sleep(0.01)


async def test_the_first_look_waits_for_the_figures_of_both_ends(calls: Calls) -> None:
    async with pair() as flows, sampling(*flows) as sampler:
        assert sampler[flows[0]].connected is None, "nobody has looked"
        begin = asyncio.get_running_loop().time()
        await sampler.settle(["/cmd"])
        assert asyncio.get_running_loop().time() - begin < limits.DIRECT_FIRST_LOOK + 0.5
        for flow in flows:
            await until(partial(lambda of: sampler[of].figures is not None and sampler[of].settled, flow))
            sample = sampler[flow]
            assert sample.connected is True
            assert sample.figures is not None
            assert sample.figures.rate is not None
            assert 0.3 * RATE < sample.figures.rate < 1.5 * RATE
            assert sample.figures.messages


async def test_without_a_look_no_node_is_asked(calls: Calls, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "DIRECT_LOOK", 0.2)
    async with pair() as flows, sampling(*flows) as sampler:
        await asyncio.sleep(0.1)
        assert calls.methods == []
        await sampler.settle(["/other"])
        assert calls.methods == [], "it has no direct connection"
        await sampler.settle(None)
        assert calls.methods
        await until(lambda: sampler.idle)
        asked = len(calls.methods)
        await asyncio.sleep(2 * limits.DIRECT_SAMPLE_FIRST)
        assert len(calls.methods) == asked, "nobody looks any more"
        assert sampler[flows[0]].figures is None, "old figures are not shown"
        await sampler.settle(["/cmd"])
        assert len(calls.methods) > asked


async def test_looks_at_topics_without_direct_connections_leave_nothing_behind() -> None:
    async with sampling() as sampler:
        for number in range(100):
            sampler.look([f"/none{number}"])
        assert sampler.idle
        assert sampler.watched == 0


async def test_a_connection_that_is_gone_is_told(calls: Calls) -> None:
    async with pair() as (viewer, talker):
        gone = viewer._replace(endpoint=("127.0.0.1", 1))
        other = talker._replace(subscriber="/other")
        async with sampling(gone, other) as sampler:
            await sampler.settle(None)
            for flow in (gone, other):
                assert sampler[flow].connected is False
                assert sampler[flow].problem == f"{flow.node} has no such connection now"


async def test_a_node_that_does_not_answer_is_told(calls: Calls, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "DIRECT_SAMPLE_TIMEOUT", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        await judge_frozen(port)


async def judge_frozen(port: int) -> None:
    """The figures of a node whose slave API is at a port where nothing answers."""
    async with pair() as (viewer, _):
        frozen = viewer._replace(uri=f"http://127.0.0.1:{port}/")
        async with sampling(frozen) as sampler:
            await sampler.settle(None)
            sample = sampler[frozen]
            assert sample.silent
            assert sample.connected is True, "the kernel has the connection all the same"
            assert sample.problem.startswith("/viewer does not tell its figures")


@pytest.mark.parametrize(
    ("stats", "problem"),
    [
        (
            RosFault(1, "<class 'OverflowError'>:int exceeds XML-RPC limits"),
            "/viewer cannot tell its figures: rospy's counters end at 2 GiB",
        ),
        (RosFault(1, "broken"), "/viewer does not tell its figures: broken"),
        ([1, "", [[], [], []]], "/viewer does not tell the figures of this connection"),
    ],
)
async def test_where_a_node_tells_no_figures_the_kernel_counts_bytes(
    calls: Calls, stats: XmlRpcValue | RosFault, problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls.stats = stats
    async with pair() as flows:
        async with sampling(*flows) as sampler:
            await sampler.settle(None)
            for flow in flows:
                sample = sampler[flow]
                assert (sample.connected, sample.silent) == (True, False)
                assert sample.problem == problem.replace("/viewer", flow.node)
                await until(partial(lambda of: of.settled, sample))
                figures = sample.figures
                assert figures is not None
                assert (figures.counted_by, figures.messages, figures.rate) == ("kernel", None, None)
                assert figures.bandwidth is not None
                assert 0.3 * RATE * MESSAGE < figures.bandwidth < 1.5 * RATE * MESSAGE
        monkeypatch.setattr(direct_sampler, "carried", lambda *_: None)
        async with sampling(*flows) as sampler:
            await sampler.settle(None)
            assert [sampler[flow].figures for flow in flows] == [None, None]
            assert sampler[flows[0]].problem == problem
            assert sampler[flows[0]].settled, "a look does not wait for what does not come"
