"""Two identical robots that meet: each is told, and parted from the other by one setting (docs/guides/names.md)."""

from __future__ import annotations

from contextlib import asynccontextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from rmpa.bridge import limits
from rmpa.config.peer_rules import PeerRule
from tests.agent.test_agent import Sink, node, running, until

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rmpa.agent.agent import Agent
    from rmpa.config.settings import Settings
    from rmpa.ros.node.endpoints import Publisher

KIND = "std_msgs/String"


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look for twins more often."""
    monkeypatch.setattr(limits, "RECONCILE_INTERVAL", 0.1)


@asynccontextmanager
async def robot(agent: Agent) -> AsyncIterator[tuple[Publisher, Sink]]:
    """The nodes of one robot; its command, and what its wheels heard."""
    heard = Sink()
    async with node("base", agent) as base, node("stick", agent) as stick:
        for topic in ("/odom", "/scan", "/diagnostics"):
            await base.advertise(topic, KIND)
        await base.subscribe("/cmd_vel", KIND, heard)
        yield await stick.advertise("/cmd_vel", KIND), heard


def problems(agent: Agent) -> list[str]:
    return [text for peer in agent.snapshots.build().peers for text in peer.conflicts]


async def test_identical_robots_are_told_and_parted(
    settings: Callable[..., Settings], caplog: pytest.LogCaptureFixture
) -> None:
    async with (
        running(settings("r1"), settings("r2")) as (r1, r2),
        robot(r1) as (drive, own),
        robot(r2) as (_, other),
    ):
        await until(lambda: problems(r1) and problems(r2))
        for agent, peer in ((r1, "r2"), (r2, "r1")):
            (text,) = problems(agent)
            assert "offer and take the same names as ours (/cmd_vel, /odom, /scan)" in text
            assert "rmpa up --prefix-peers" in text
            assert f'name = "{peer}" and prefix = "/{{peer}}"' in text
        await until(lambda: drive.subscribers == 2)
        drive.publish(drive.make({"data": "both"}))
        await until(lambda: own.heard and other.heard)
        told = [record.getMessage() for record in caplog.records if "offer and take" in record.getMessage()]
        assert sorted(text[:4] for text in told) == ["! r1", "! r2"], "once at each end"
        for agent, name in ((r1, "r1"), (r2, "r2")):
            agent.apply_settings(replace(settings(name), prefix_peers=True))
        await until(lambda: not problems(r1) and not problems(r2) and drive.subscribers == 1)
        drive.publish(drive.make({"data": "mine"}))
        await until(lambda: own.heard == ["both", "mine"])
        assert other.heard == ["both"]
        assert "/r1/cmd_vel" in r2.core.state().publishers


async def test_a_peer_about_which_the_user_has_decided_is_no_twin(settings: Callable[..., Settings]) -> None:
    decided = replace(settings("r1"), peers=(PeerRule("r2"),))
    async with running(decided, settings("r2")) as (r1, r2), robot(r1), robot(r2):
        await until(lambda: problems(r2))
        assert not problems(r1)
