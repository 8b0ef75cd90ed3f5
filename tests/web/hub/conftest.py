from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.web import limits
from tests.web.hub.client import local_core

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from rmpa.ros.core.embedded import RosCore


@pytest.fixture(autouse=True)
def _withdrawn_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "UNADVERTISE_DELAY", 0.0)


@pytest.fixture
async def core() -> AsyncIterator[RosCore]:
    """A ROS core of its own."""
    async with local_core() as made:
        yield made
