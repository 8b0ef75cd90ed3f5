"""Sites whose gateways have certificates, by a router that lets in members: gateways judge names."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from rmpa.config.rules import Crossing, CrossingRule
from tests.gateway.sites.site_bed import SiteBed, described
from tests.gateway.zenoh_bed import ZenohBed, until
from tests.gateway.zenoh_fleet import Fleet

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from rmpa.gateway.zenoh.session import OpenSession

pytest.importorskip("zenoh")


class SecuredBed(ZenohBed):
    """Sessions of the gateways of one fleet."""

    def __init__(self, fleet: Fleet) -> None:
        super().__init__()
        self._fleet = fleet
        self._number = 0

    async def session(self) -> OpenSession:
        self._number += 1
        return await self._fleet.gateway(f"gateway{self._number}")


@asynccontextmanager
async def secured(folder: Path) -> AsyncIterator[SiteBed]:
    """A router of a secured mesh."""
    fleet = Fleet(folder)
    sites = SiteBed(SecuredBed(fleet))
    try:
        await fleet.router()
        yield sites
    finally:
        for site in sites.opened:
            await site.neighbour.close()
        await fleet.close()


async def test_a_topic_for_one_site_alone_crosses_a_router_of_a_secured_mesh(tmp_path: Path) -> None:
    rules = (CrossingRule(sites=("hall",)), CrossingRule(crossing=Crossing.NONE))
    async with secured(tmp_path) as bed:
        yard = await bed.site("yard", rules=rules)
        hall, cellar = await bed.site("hall"), await bed.site("cellar")
        yard.graph.send(yard.graph.add("/scan", described(latching=True)), b"ranges")
        topic = await hall.subscribed("/scan")
        await until(lambda: topic.messages)
        assert topic.messages == [b"ranges"]
        assert not cellar.shows("/scan")
