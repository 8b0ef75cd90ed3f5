"""Sites whose gateways have certificates: the router lets members in, the gateways judge names."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from rmpa.bridge.policy import PermissionGate
from rmpa.config.rules import Crossing, CrossingRule
from rmpa.config.settings import TrustSettings
from rmpa.gateway.neighbour import ZenohQos
from rmpa.trust.permissions import Permissions
from tests.gateway.sites.site_bed import SiteBed, described
from tests.gateway.zenoh_bed import ZenohBed, until
from tests.gateway.zenoh_fleet import Fleet, allow

if TYPE_CHECKING:
    from pathlib import Path

    from rmpa.config.peer_rules import PermissionRule
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


def gate(*rules: PermissionRule) -> PermissionGate:
    return PermissionGate(Permissions(TrustSettings(rules=rules)))


async def test_a_topic_and_its_header_cross_where_both_sites_may_and_nothing_else_does(tmp_path: Path) -> None:
    """The router lets every member through; the gateways at both ends judge the names."""
    fleet = Fleet(tmp_path)
    sites = SiteBed(SecuredBed(fleet, "yard_gateway", "hall_gateway", "eve_gateway"))
    try:
        await fleet.router()
        yard = await sites.site("yard", gate=gate(allow("hall", subscribe="/scan /map")))
        hall = await sites.site("hall", gate=gate(allow("yard", publish="/**")))
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
        yard.graph.send(secret, b"hidden")
        await until(lambda: topic.messages and kept.messages)
        assert (topic.messages, kept.messages) == ([b"ranges"], [b"walls"])
        assert b"hidden" not in hall.topic("/secret").messages
        assert hall.topic("/secret").description is None

        eve = await sites.site("eve")
        eve.graph.add("/stop", described())
        await until(lambda: eve.shows("/scan"))
        eve.topic("/scan").on_demand(True)
        forged = eve.session.publisher("rmpa/1/yard/arm/t/odd_msgs%Odd/scan", ZenohQos(), lambda _: None)
        forged.put(b"forged")
        await until(lambda: forged.sent)
        yard.graph.send(scan, b"again")
        await until(lambda: len(topic.messages) == 2)
        assert topic.messages == [b"ranges", b"again"], "a message without the attachment of a gateway is none"
        assert eve.topic("/scan").description is None, "no permission of the yard names it"
        assert not hall.shows("/stop"), "no permission of the hall names it"
    finally:
        for site in sites.opened:
            await site.neighbour.close()
        await fleet.close()


async def test_a_topic_for_one_site_alone_crosses_a_router_of_members(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path)
    sites = SiteBed(SecuredBed(fleet, "yard_gateway", "hall_gateway", "cellar_gateway"))
    try:
        await fleet.router()
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
