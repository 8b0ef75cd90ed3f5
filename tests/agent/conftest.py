"""Agents run on the loop that they have in life: it tells a pause of its own from an outage, and data goes first."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from rmpa.config.peer_rules import PolicySettings
from rmpa.config.settings import Settings
from rmpa.config.values import Multicast
from rmpa.runtime.loop import AgentLoop

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path


def pytest_asyncio_loop_factories(
    config: pytest.Config,
    item: pytest.Item,
) -> Mapping[str, Callable[[], AgentLoop]]:
    return {"agent": AgentLoop}


@pytest.fixture
def settings(tmp_path: Path) -> Callable[..., Settings]:
    group_port = 20000 + os.getpid() % 20000

    def make(name: str, policy: PolicySettings | None = None, core_port: int = 0) -> Settings:
        return Settings(
            name=name,
            core_port=core_port,
            interfaces=("lo",),
            multicast=Multicast(port=group_port),
            policy=policy or PolicySettings(),
            runtime_dir=str(tmp_path),
        )

    return make
