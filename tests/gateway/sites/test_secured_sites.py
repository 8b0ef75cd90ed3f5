"""Sites whose gateways have certificates, by a router that lets in members: gateways judge names."""

from __future__ import annotations

from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import pytest

from rmpa.bridge.policy import PermissionGate
from rmpa.config.rules import Crossing, CrossingRule
from rmpa.config.settings import TrustSettings
from rmpa.trust.permissions import Permissions
from tests.gateway.sites.site_bed import SiteBed, described
from tests.gateway.zenoh_bed import ZenohBed, until
from tests.gateway.zenoh_fleet import Fleet, allow

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


async def test_a_topic_and_its_header_cross_where_both_sites_may_and_nothing_else_does(tmp_path: Path) -> None:
    rules = (allow("hall", subscribe="/scan /map"), allow("hall", publish="/**"))
    gate = PermissionGate(Permissions(TrustSettings(rules=rules)))
    incoming = PermissionGate(Permissions(TrustSettings(rules=(allow("yard", publish="/scan /map /secret"),))))
    async with secured(tmp_path) as bed:
        yard, hall = await bed.site("yard", gate=gate), await bed.site("hall", gate=incoming)
        scan, latched = yard.graph.add("/scan", described()), yard.graph.add("/map", described(latching=True))
        for name in ("/secret", "/cmd_vel"):
            yard.graph.add(name, described())
        topic, kept = await hall.subscribed("/scan"), await hall.subscribed("/map")
        yard.graph.send(scan, b"ranges")
        yard.graph.send(latched, b"walls")
        await until(lambda: topic.messages and kept.messages)
        assert (topic.messages, kept.messages) == ([b"ranges"], [b"walls"])
        await until(lambda: hall.shows("/secret"))
        hall.topic("/secret").on_demand(True)
        await until(lambda: "do not let hall subscribe to /secret" in hall.imported("/secret").problem)
        assert not hall.imported("/secret").wanted, "it is not asked for again"
        assert hall.topic("/secret").description is None
        assert not hall.shows("/cmd_vel"), "this site does not let the other one publish it"


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
