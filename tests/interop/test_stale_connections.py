"""Stale connections of real nodes; and what an agent says that may not end them."""

from __future__ import annotations

import asyncio
import os
from typing import Final

import pytest

from rmpa.ros.core.embedded import RosCore
from rmpa.runtime.kernel_tcp import connections, end_connections, may_end_connections
from tests.interop.conftest import AgentFactory
from tests.interop.ros import Ros
from tests.interop.test_core_nodes import publisher_at
from tests.interop.test_realtime import Prefixed, runs
from tests.ros.node.peers import RawSubscriber

WITHOUT_NET_ADMIN: Final = ("setpriv", "--bounding-set=-net_admin")
DEADLINE: Final = 60.0
CONFIG: Final = '[bridge]\ntransport = "{}"\n'

needs_the_right = pytest.mark.skipif(bool(may_end_connections()), reason="connections cannot be ended here")
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to drop a capability")


@needs_root
@needs_the_right
def test_an_agent_without_the_capability_is_told_what_to_do(agent: AgentFactory) -> None:
    if not runs(WITHOUT_NET_ADMIN):
        pytest.skip("capabilities cannot be dropped here")
    bare = Prefixed("bare", "", prefix=WITHOUT_NET_ADMIN)
    warned = agent(bare, config=CONFIG.format("auto"))
    warned.process.wait_for(
        "the agent may not end connections that a vanished host leaves behind .*AmbientCapabilities"
    )
    silent = agent(bare, config=CONFIG.format("relay"))
    assert "may not end" not in silent.process.output, "nothing of this agent goes direct"


@pytest.mark.ros
@needs_the_right
@pytest.mark.parametrize("queue", [-1, 10])
async def test_a_rospy_publisher_goes_on_when_a_stale_connection_is_ended(
    core: RosCore, ros: Ros, queue: int
) -> None:
    """The stale subscriber reads nothing, as one on a host that vanished; 200 MB fit no socket's buffers."""
    sent, size = 2000, 100_000
    talker = ros.rospy(
        "talker", "__name:=talker", topic="/chatter", rate=0, size=size, count=sent, wait=2, queue=queue
    )
    await talker.expect_event("up", DEADLINE)
    address = await publisher_at(core)
    stale = await RawSubscriber.connect(address, buffer=4096, topic="/chatter", md5sum="*", type="*")
    try:
        await stale.header()
        listener = ros.rospy("listener", topic="/chatter", count=1 if queue >= 0 else sent)
        await talker.expect_event("connected", DEADLINE)
        if queue >= 0:  # with a queue a thread of its own hangs, and publish() goes on
            await talker.expect_event("done", DEADLINE)
        await asyncio.get_running_loop().sock_recv(stale.sock, 1)  # the first message has begun to come
        assert bool(talker.events("done")) is (queue >= 0)
        found = connections(remote=stale.sock.getsockname())
        assert found is not None
        assert end_connections(found) == 1
        assert (await talker.expect_event("done", DEADLINE))["sent"] == sent
        await listener.expect_event("done", DEADLINE)
    finally:
        stale.close()
