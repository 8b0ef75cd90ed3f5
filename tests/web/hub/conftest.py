from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from tests.web.hub.client import local_core

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.ros.core.embedded import RosCore


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    """A ROS core of its own."""
    async with local_core() as made:
        yield made
