"""What real nodes tell about their connections is what really flows."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from rmpa.ros.core.embedded import RosCore
from rmpa.ros.http.rpc import call
from rmpa.ros.wire.slave_api import read_bus_info

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.ros.wire.slave_api import BusLink
    from tests.interop.conftest import ShellFactory

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
LIBRARIES = ("rospy", "roscpp")
DEADLINE = 90.0
TOPIC = "/chatter"
COUNT, SIZE = 50, 64


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


@pytest.mark.trap(41)
async def test_connections_of_real_nodes_are_read(core: RosCore, shell: ShellFactory) -> None:
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
        for listener in LIBRARIES:
            (end,) = (one for one in sent if one.other == f"/hears_{listener}")
            (start,) = (
                one for one in await links(core, f"/hears_{listener}") if one.other == uri_of(core, f"/says_{talker}")
            )
            assert (start.inbound, start.connected, start.remote) == (True, True, ("127.0.0.1", end.local_port))
            assert end.remote == ("127.0.0.1", start.local_port)
