from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.web.hub.client import local_core, node, running_hub

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.ros.core.embedded import RosCore
    from rmpa.ros.node.node import Node
    from rmpa.web.hub.hub import Hub


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    """A ROS core of its own."""
    async with local_core() as made:
        yield made


@pytest.fixture
async def hub(core: RosCore) -> AsyncIterator[Hub]:
    """A hub at the core that has read the graph and the parameters."""
    async with running_hub(core) as made:
        yield made


@pytest.fixture
async def talker(core: RosCore) -> AsyncIterator[Node]:
    """Another node of the core."""
    async with node(core, "talker") as made:
        yield made
