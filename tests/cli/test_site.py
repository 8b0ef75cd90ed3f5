"""``rmpa site`` beside a fake agent."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

from rmpa.core.errors import PeerRefused
from rmpa.observe.control_server import ControlServer, Handler
from rmpa.observe.peer_info import SiteInfo, SiteModuleInfo, SiteSourceInfo, SitesReport
from tests.observe.samples import SNAPSHOT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rmpa.observe.snapshot import Snapshot
    from tests.cli.conftest import Background, Place

ARM = SiteModuleInfo(name="arm", instance="0" * 32, topics=2, services=1, shown=2)
HERE = SiteInfo(name="office", state="this site", gateways=1)
JOINED = SiteInfo(name="warehouse", state="joined", since_ago=12.0, gateways=2, modules=(ARM,))
REPORT = SitesReport(
    gateway="gate", site="office", leads=True, rank=100, endpoints=("tcp/10.0.0.1:7447",), sites=(HERE, JOINED)
)
SOURCES = (
    SiteSourceInfo(kind="topic", module="arm", node="/n", name="/scan", type="sensor_msgs/LaserScan", here="/scan"),
    SiteSourceInfo(
        kind="service", module="arm", node="/n", name="/stop", problem="gateway.rule 1 lets it not come in\x1b[2J"
    ),
)


@pytest.fixture
def answers(place: Place, background: Background) -> Iterator[Callable[[Handler], None]]:
    servers: list[ControlServer] = []

    def start(handler: Handler) -> None:
        def snapshot(_: dict[str, object]) -> Snapshot:
            return SNAPSHOT

        server = ControlServer(place.path, "base", {"snapshot": snapshot, "site": handler})
        background.do(server.start())
        servers.append(server)

    yield start
    for server in servers:
        background.do(server.close())


def test_sites_are_listed_and_all_is_well(place: Place, answers: Callable[[Handler], None]) -> None:
    answers(lambda _: [REPORT])
    code, out, err = place.run("site", "list")
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        "SITE       STATE       SINCE  GATEWAYS  MODULES  SOURCES  SHOWN  BY",
        "office     this site       -         1        0        0      0  gate",
        "warehouse  joined     12.0 s         2        1        3      2  gate",
    ]
    (line,) = place.json("site", "list", "--json")
    assert line[0]["sites"][1]["name"] == "warehouse"  # type: ignore[index]


@pytest.mark.parametrize(
    ("reports", "said"),
    [
        ([], "base is no gateway, and is linked to none: start one with `rmpa gateway --site NAME`"),
        ([SitesReport(gateway="g", site="office", sites=(HERE,))], "g of site office knows no other site"),
        (
            [SitesReport(gateway="g", site="a", problem="no router", sites=(HERE, JOINED))],
            "g: no router",
        ),
        (
            [SitesReport(gateway="g", site="a", sites=(HERE, SiteInfo(name="b", state="unreachable", since_ago=3)))],
            "",
        ),
    ],
)
def test_what_is_not_well_is_said(
    place: Place, answers: Callable[[Handler], None], reports: list[SitesReport], said: str
) -> None:
    answers(lambda _: reports)
    code, _, err = place.run("site", "list")
    assert said in err
    assert code == (0 if said.startswith("g of") else 1)
    if not reports:
        code, out, err = place.run("site", "list", "--json")
        assert (code, out.strip(), said in err) == (1, "[]", True), "an empty list has a reason too"


def test_a_site_is_shown_with_what_does_not_cross(place: Place, answers: Callable[[Handler], None]) -> None:
    asked: list[dict[str, Any]] = []

    def answer(args: dict[str, Any]) -> SitesReport:
        asked.append(args)
        shown = SiteInfo(name="warehouse", gateways=1, modules=(ARM,), sources=SOURCES, not_shown=1)
        return SitesReport(gateway="gate", site="office", leads=True, sites=(shown,))

    answers(answer)
    code, out, err = place.run("site", "info", "warehouse")
    assert code == 0
    assert asked == [{"what": "site.info", "args": {"site": "warehouse"}}]
    assert "Seen by:   gate of site office" in out.splitlines()
    assert "  /scan  topic    sensor_msgs/LaserScan  arm     /n    /scan" in out.splitlines()
    assert "! /stop of arm: gateway.rule 1 lets it not come in\\x1b[2J" in err


def test_an_unknown_site_offers_the_nearest(place: Place, answers: Callable[[Handler], None]) -> None:
    answers(lambda _: REPORT)
    code, _, err = place.run("site", "info", "warehuose")
    assert (code, err) == (1, "rmpa: gate knows no site 'warehuose'; did you mean warehouse?\n")


def test_errors_of_gateways_are_told(place: Place, answers: Callable[[Handler], None]) -> None:
    def refuse(_: dict[str, object]) -> object:
        raise PeerRefused("gate", "site warehouse is unreachable since 6 s")

    answers(refuse)
    code, out, err = place.run("site", "info", "warehouse", "--json")
    assert code == 1
    assert json.loads(out) == {"error": "gate refused: site warehouse is unreachable since 6 s"}
    assert err.startswith("rmpa: gate refused: site warehouse is unreachable")
