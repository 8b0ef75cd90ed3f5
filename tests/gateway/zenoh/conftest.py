"""A router for each test, and sessions that are its clients."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest

from rmpa.gateway.zenoh.session import OpenSession
from tests.gateway.zenoh_bed import ZenohBed


@pytest.fixture
async def net() -> AsyncIterator[ZenohBed]:
    async with pytest.importorskip("tests.gateway.zenoh_bed").bed() as made:
        yield made


@pytest.fixture
async def pair(net: ZenohBed) -> tuple[OpenSession, OpenSession]:
    """One that sends or answers, and one that receives or asks."""
    return await net.session(), await net.session()
