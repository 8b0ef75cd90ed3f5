"""Parked peers in a secured mesh: what concerns all members reaches them, and a revoked one is gone."""

from __future__ import annotations

from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

from rmpa.core.links import Links
from rmpa.ros.node.node import Node
from rmpa.trust.documents import DocumentKind
from tests.agent.test_agent import until
from tests.agent.test_parked import parked, soon
from tests.agent.test_trust import a_fleet

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["soon"]


async def test_a_revocation_reaches_parked_peers_and_ends_a_parked_one(tmp_path: Path) -> None:
    async with a_fleet(tmp_path) as fleet, AsyncExitStack() as stack:
        await fleet.stop("base")
        await fleet.start("base", links=Links.DEMAND)
        for name in ("arm", "stick", "thief"):
            await fleet.add(name, links=Links.DEMAND)
        await until(lambda: all(len(list(agent.bridge.sessions)) == 3 for agent in fleet.agents.values()))
        thief = await stack.enter_async_context(Node("talker", master_uri=fleet.agents["thief"].core.uri))
        await thief.advertise("/cmd_vel", "std_msgs/String")
        honest = [fleet.agents[name] for name in ("base", "arm", "stick")]
        await until(lambda: all("/cmd_vel" in agent.core.state().publishers for agent in honest))
        await parked(*fleet.agents.values())
        await fleet.command("base", "revoke", name="thief")
        await until(lambda: not any("/cmd_vel" in agent.core.state().publishers for agent in honest))
        members = [agent.trust.membership for agent in honest if agent.trust is not None]
        await until(lambda: all(member.numbers[DocumentKind.KEYS] == 2 for member in members))
        await parked(*honest)
