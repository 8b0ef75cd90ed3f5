"""Agents run on the loop that they have in life: it tells a pause of its own from an outage, and data goes first."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.runtime.loop import AgentLoop

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import pytest


def pytest_asyncio_loop_factories(
    config: pytest.Config,
    item: pytest.Item,
) -> Mapping[str, Callable[[], AgentLoop]]:
    return {"agent": AgentLoop}
