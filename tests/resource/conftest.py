from __future__ import annotations

from collections.abc import AsyncIterator

import pytest

from rmpa.resource.reconfigure import DESCRIPTION_TYPE
from rmpa.ros.core.embedded import RosCore
from rmpa.ros.node.node import Node
from rmpa.ros.types.definitions import ARRAY_TYPE
from rmpa.ros.types.descriptor import CONFIG_TYPE, SERVICE_TYPE
from rmpa.ros.types.installed import ServiceType
from rmpa.ros.types.messages import MessageType


@pytest.fixture(scope="session", autouse=True)
def _warm() -> None:
    """Import numpy and rosbags, and read definitions, before a test watches for blocking calls."""
    for name in (
        "std_msgs/String",
        ARRAY_TYPE,
        CONFIG_TYPE,
        DESCRIPTION_TYPE,
        "sensor_msgs/BatteryState",
        "std_msgs/Bool",
    ):
        kind = MessageType(name)
        kind.deserialize(kind.serialize(kind.make()))
    ServiceType(SERVICE_TYPE)


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    one = RosCore(port=0)
    await one.start()
    yield one
    await one.close()


@pytest.fixture
async def node(core: RosCore) -> AsyncIterator[Node]:
    async with Node("client", master_uri=core.uri) as one:
        yield one
