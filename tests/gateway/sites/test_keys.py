"""Keys and tokens of sites: golden texts, and what is no token."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rmpa.core.errors import RemoteProtocolError
from rmpa.gateway import limits
from rmpa.gateway.rules import SourceKind
from rmpa.gateway.sites.keys import (
    SiteGateway,
    SiteModule,
    SiteSource,
    data_key,
    parse_token,
    token_keys,
)
from tests.gateway.memory_zenoh import fits

RUN = "0123456789abcdef0123456789abcdef"
ARM = SiteModule("warehouse", "arm", RUN)
SCAN = SiteSource(ARM, SourceKind.TOPIC, "sensor_msgs/LaserScan", "/lidar/driver", "/base/scan")
FOR_YARD = replace(SCAN, to="yard")
GATEWAY = SiteGateway("warehouse", 10, RUN)


@pytest.mark.parametrize(
    ("each", "token"),
    [
        (ARM, f"rmpa/1/warehouse/arm/up/{RUN}"),
        (SCAN, f"rmpa/1/warehouse/arm/up/{RUN}/t/sensor_msgs%LaserScan/%lidar%driver/%base%scan"),
        (FOR_YARD, f"rmpa/1/warehouse/arm/to/{RUN}/yard/t/sensor_msgs%LaserScan/%lidar%driver/%base%scan"),
        (GATEWAY, f"rmpa/1/warehouse/-gateway/010/{RUN}"),
        (SiteModule("home", "gateway", RUN), f"rmpa/1/home/gateway/up/{RUN}"),  # a module may be called so
    ],
)
def test_golden_tokens(each: SiteModule | SiteSource | SiteGateway, token: str) -> None:
    assert (each.token(), parse_token(token)) == (token, each)


def test_golden_keys() -> None:
    assert SCAN.key() == "rmpa/1/warehouse/arm/t/sensor_msgs%LaserScan/base/scan"
    assert data_key("*", "*", SourceKind.SERVICE, "std_srvs/Trigger", "/stop") == "rmpa/1/*/*/s/std_srvs%Trigger/stop"
    assert FOR_YARD.key() == "rmpa/1/warehouse/arm/to/yard/t/sensor_msgs%LaserScan/base/scan"
    assert token_keys("yard") == ("rmpa/1/*/-gateway/**", "rmpa/1/*/*/up/**", "rmpa/1/*/*/to/*/yard/**")


def test_a_gateway_follows_each_token_that_is_for_all_or_for_its_site_once() -> None:
    for each, sites in ((ARM, "ab"), (SCAN, "ab"), (GATEWAY, "ab"), (replace(FOR_YARD, to="a"), "a")):
        told = [site for site in "ab" for key in token_keys(site) if fits(key, each.token())]
        assert "".join(told) == sites


def test_a_service_whose_type_is_unknown_is_announced_and_called_by_any_type() -> None:
    stop = SiteSource(ARM, SourceKind.SERVICE, "*", "/driver", "/stop")
    assert stop.token() == f"{ARM.token()}/s/-/%driver/%stop"
    assert stop.key() == "rmpa/1/warehouse/arm/s/*/stop"
    assert parse_token(stop.token()) == stop
    with pytest.raises(RemoteProtocolError):
        parse_token(f"{ARM.token()}/t/-/%driver/%stop")


@pytest.mark.parametrize("more", ["/x", "/t/a%B/%n/%t/more", "/z/a%B/%n/%t"])
def test_what_a_later_version_announces_is_ignored(more: str) -> None:
    assert parse_token(ARM.token() + more) is None
    assert parse_token(f"rmpa/1/home/arm/later/{RUN}") is None


@pytest.mark.parametrize(
    "key",
    [
        "",
        "rmpa/1/home",
        f"rmpa/2/home/arm/up/{RUN}",
        f"rmpa/1/ho-me/arm/up/{RUN}",
        f"rmpa/1/home/4rm/up/{RUN}",
        f"rmpa/1/home/arm/up/{RUN[:-1]}",
        f"rmpa/1/home/arm/up/{RUN.upper()}",
        f"rmpa/1/home/-gateway/first/{RUN}",
        f"rmpa/1/home/-gateway/1000/{RUN}",
        f"rmpa/1/home/-gateway/²/{RUN}",
        f"rmpa/1/home/arm/up/{RUN}/t/std_msgs/%node/%topic",
        f"rmpa/1/home/arm/to/{RUN}/ya-rd/t/std_msgs%String/%node/%topic",
        f"rmpa/1/home/arm/up/{RUN}/t/std_msgs%String/node/%topic",
        f"rmpa/1/home/arm/up/{RUN}/t/std_msgs%String/%node/%to pic",
        f"rmpa/1/home/arm/up/{RUN}/t/std_msgs%String/%node/%{'a' * limits.KEY_MAX}",
    ],
)
def test_what_is_no_token_is_refused(key: str) -> None:
    with pytest.raises(RemoteProtocolError):
        parse_token(key)
