"""What a real core says of its module's time."""

from __future__ import annotations

import asyncio

from rmpa.observe.doctor.machine import read_sim_time
from rmpa.ros.core.embedded import RosCore


async def test_the_nodes_that_give_the_time_are_asked_of_the_core() -> None:
    core = RosCore("127.0.0.1", 0)
    await core.start()
    try:
        assert await asyncio.to_thread(read_sim_time, core.uri) is None
        core.call("setParam", "/x", "/use_sim_time", True)
        assert await asyncio.to_thread(read_sim_time, core.uri) == []
        core.call("registerPublisher", "/gazebo", "/clock", "rosgraph_msgs/Clock", "http://127.0.0.1:1/")
        assert await asyncio.to_thread(read_sim_time, core.uri) == ["/gazebo"]
    finally:
        await core.close()
    assert await asyncio.to_thread(read_sim_time, core.uri) is None
