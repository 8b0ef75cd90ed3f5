"""What real nodes tell about their connections and their traffic is what really flows."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from rmpa.ros.core.embedded import RosCore
from rmpa.ros.http.client import call
from rmpa.ros.wire.bus import read_bus_info, read_bus_stats
from rmpa.ros.wire.xmlrpc import RosFault

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.ros.wire.bus import BusLink, BusTraffic
    from tests.interop.conftest import ShellFactory

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
LIBRARIES = ("rospy", "roscpp")
DEADLINE = 90.0
TOPIC = "/chatter"
COUNT, SIZE = 50, 64
MESSAGE = 12 + SIZE
"""A std_msgs/UInt8MultiArray without its length in TCPROS: 8 bytes of layout, and the length of the array."""
HEADERS_MAX = 4096


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    made = RosCore("127.0.0.1", 0)
    await made.start()
    yield made
    await made.close()


def uri_of(core: RosCore, node: str) -> str:
    state = core.state()
    return next(nodes[node] for nodes in (*state.publishers.values(), *state.subscribers.values()) if nodes.get(node))


async def links(core: RosCore, node: str) -> list[BusLink]:
    """A node's connections of the topic."""
    return [one for one in read_bus_info(await call(uri_of(core, node), "getBusInfo", "/t")) if one.topic == TOPIC]


async def traffic(core: RosCore, node: str) -> list[BusTraffic]:
    """A node's traffic of the topic."""
    return [one for one in read_bus_stats(await call(uri_of(core, node), "getBusStats", "/t")) if one.topic == TOPIC]


async def until(core: RosCore, node: str, holds: Callable[[list[BusTraffic]], bool]) -> list[BusTraffic]:
    """A node's traffic once it is as expected: nodes count a message after they have handed it on."""
    async with asyncio.timeout(DEADLINE):
        while not holds(found := await traffic(core, node)):
            await asyncio.sleep(0.02)
    return found


def all_messages(found: list[BusTraffic]) -> bool:
    return bool(found) and all(one.messages == COUNT for one in found)


@pytest.mark.trap(41)
async def test_connections_and_traffic_of_real_nodes_are_read(core: RosCore, shell: ShellFactory) -> None:
    ros = shell(port=core.port)
    processes = [ros.node(library, "listener", name=f"hears_{library}", count=2 * COUNT) for library in LIBRARIES]
    for library in LIBRARIES:
        ros.node(library, "talker", name=f"says_{library}", count=COUNT, size=SIZE, rate=100, wait=2)
    for process in processes:
        await asyncio.to_thread(process.wait_event, "done", timeout=DEADLINE)
    for talker in LIBRARIES:
        sent = await links(core, f"/says_{talker}")
        assert {(one.other, one.inbound, one.connected) for one in sent} == {
            ("/hears_rospy", False, True),
            ("/hears_roscpp", False, True),
        }
        counted = await until(core, f"/says_{talker}", all_messages)
        assert {one.number for one in counted} == {one.number for one in sent}
        for one in counted:
            headers = HEADERS_MAX if talker == "rospy" else 0
            assert 0 <= one.bytes - COUNT * (MESSAGE + 4) <= headers
            assert (one.inbound, one.dropped) == (False, None)
        for listener in LIBRARIES:
            (end,) = (one for one in sent if one.other == f"/hears_{listener}")
            (start,) = (
                one for one in await links(core, f"/hears_{listener}") if one.other == uri_of(core, f"/says_{talker}")
            )
            assert (start.inbound, start.connected, start.remote) == (True, True, ("127.0.0.1", end.local_port))
            assert end.remote == ("127.0.0.1", start.local_port)
    heard = await until(core, "/hears_rospy", all_messages)
    assert len(heard) == 2
    assert all(0 <= one.bytes - COUNT * (MESSAGE + 4) <= HEADERS_MAX and one.dropped is None for one in heard)
    (last,) = await until(core, "/hears_roscpp", all_messages)
    assert last.number == max(one.number for one in await links(core, "/hears_roscpp"))
    assert (last.bytes, last.inbound, last.dropped) == (COUNT * MESSAGE, True, 0)


@pytest.mark.trap(41)
async def test_above_2_gib_roscpp_wraps_and_rospy_answers_a_fault(core: RosCore, shell: ShellFactory) -> None:
    count, size = 136, 16_000_000
    ros = shell(port=core.port)
    ros.rospy("listener", name="hears_rospy")
    hears = ros.roscpp("listener", name="hears_roscpp", count=count)
    ros.roscpp("talker", name="says", count=count, size=size, rate=20, wait=2)
    await asyncio.to_thread(hears.wait_event, "done", timeout=DEADLINE)

    def complete(found: list[BusTraffic]) -> bool:
        return bool(found) and all(one.messages == count for one in found)

    sent = await until(core, "/says", complete)
    assert [one.bytes for one in sent] == [count * (12 + size + 4)] * 2
    (heard,) = await until(core, "/hears_roscpp", complete)
    assert heard.bytes == count * (12 + size) > 2**31
    with pytest.raises(RosFault, match="int exceeds XML-RPC limits"):
        await until(core, "/hears_rospy", complete)
