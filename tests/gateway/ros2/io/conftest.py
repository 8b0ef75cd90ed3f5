"""What needs the extra ``rmpa[zenoh]`` is skipped without it: GIDs of ROS 2 are hashes that xxhash makes."""

from __future__ import annotations

import importlib.util
from collections.abc import AsyncIterator

import pytest

from tests.gateway.ros2.io.ros2_bed import Ros2Bed, ros2_bed


@pytest.fixture(autouse=True)
def _needs_xxhash() -> None:
    if importlib.util.find_spec("xxhash") is None:
        pytest.skip("the extra rmpa[zenoh] is not installed")


@pytest.fixture
async def bed() -> AsyncIterator[Ros2Bed]:
    async with ros2_bed() as made:
        yield made
