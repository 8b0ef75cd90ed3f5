"""Sites whose gateways have certificates, by a router that enforces the rules of ``[[permission]]``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.config.rules import Crossing, CrossingRule
from rmpa.gateway.neighbour import ZenohQos
from tests.gateway.sites.site_bed import SiteBed, described
from tests.gateway.zenoh_bed import ZenohBed, until
from tests.gateway.zenoh_fleet import Fleet, allow

if TYPE_CHECKING:
    from pathlib import Path

    from rmpa.gateway.zenoh.session import OpenSession

pytest.importorskip("zenoh")


class SecuredBed(ZenohBed):
    """Sessions of gateways with these names, in order."""

    def __init__(self, fleet: Fleet, *names: str) -> None:
        super().__init__()
        self._fleet = fleet
        self._names = iter(names)

    async def session(self) -> OpenSession:
        return await self._fleet.gateway(next(self._names))


async def test_a_topic_and_its_header_cross_where_both_sites_may_and_nothing_else_does(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    sites = SiteBed(SecuredBed(fleet, "yard_gateway", "hall_gateway"))
    try:
        await fleet.router(
            allow("yard_gateway", publish="/scan /map /secret"), allow("hall_gateway", subscribe="/scan /map")
        )
        yard, hall = await sites.pair()
        scan = yard.graph.add("/scan", described())
        secret = yard.graph.add("/secret", described())
        latched = yard.graph.add("/map", described(latching=True))
        topic = await hall.subscribed("/scan")
        kept = await hall.subscribed("/map")
        await until(lambda: hall.shows("/secret"))
        hall.topic("/secret").on_demand(True)
        await until(lambda: any(tap.source == scan for tap in yard.graph.taps))
        yard.graph.send(scan, b"ranges")
        yard.graph.send(latched, b"walls")
        await until(lambda: topic.messages and kept.messages)
        assert (topic.messages, kept.messages) == ([b"ranges"], [b"walls"])
        assert not any(tap.source == secret for tap in yard.graph.taps), "the router tells of no demand for it"
        assert hall.topic("/secret").description is None

        eve = await fleet.gateway("eve_gateway")
        forged = eve.publisher("rmpa/1/yard/arm/t/odd_msgs%Odd/scan", ZenohQos(), lambda _: None)
        forged.put(b"forged")
        await until(lambda: forged.sent)
        yard.graph.send(scan, b"again")
        await until(lambda: len(topic.messages) == 2)
        assert topic.messages == [b"ranges", b"again"]
    finally:
        for site in sites.opened:
            await site.neighbour.close()
        await fleet.close()


async def test_a_topic_for_one_site_alone_crosses_a_router_that_knows_its_permission(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    sites = SiteBed(SecuredBed(fleet, "yard_gateway", "hall_gateway", "cellar_gateway"))
    try:
        await fleet.router(
            allow("yard_gateway", publish="/scan"),
            allow("hall_gateway", subscribe="/scan"),
            allow("cellar_gateway", subscribe="/scan"),
        )
        rules = (CrossingRule(sites=("hall",)), CrossingRule(crossing=Crossing.NONE))
        yard = await sites.site("yard", rules=rules)
        hall, cellar = await sites.site("hall"), await sites.site("cellar")
        scan = yard.graph.add("/scan", described(latching=True))
        yard.graph.send(scan, b"ranges")
        topic = await hall.subscribed("/scan")
        await until(lambda: topic.messages)
        assert topic.messages == [b"ranges"]
        assert not cellar.shows("/scan")
    finally:
        for site in sites.opened:
            await site.neighbour.close()
        await fleet.close()
