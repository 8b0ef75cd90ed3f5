"""ROS 2 in ``rmpa site`` and ``rmpa why``."""

from __future__ import annotations

from typing import Any

import pytest

from rmpa.core.errors import UnreachableError
from rmpa.observe.sites import PARAM, REPORT, SITE_INFO, WHY, SiteInfo, SitesReport
from tests.gateway.memory_zenoh import eventually
from tests.gateway.ros2.io.ros2_bed import NO_TYPE, STRING, Ros2Bed


class OtherSites:
    """Answers for another site."""

    async def answer(self, what: str, _args: dict[str, Any], _asker: str = "", /) -> Any:
        sites = (SiteInfo(name="hall", state="this site"),)
        return SitesReport(gateway="gate", site="hall", sites=sites) if what == REPORT else ["of a site"]


async def test_ros2_is_listed_with_its_topics_and_what_is_wrong_with_them(bed: Ros2Bed) -> None:
    bed.graph.publisher("/mine", STRING)
    bed.publisher("/chatter")
    bed.subscribe("/mine", node="/older", type_hash=NO_TYPE)
    await eventually(lambda: bed.problems and bed.topic("/chatter"))
    answer = bed.neighbour.answer
    report: SitesReport = await answer(REPORT, {})
    assert [(site.name, site.state) for site in report.sites] == [("ros2", "joined")]
    (info,) = (await answer(SITE_INFO, {"site": "ros2"})).sites
    rows = {(row.name, row.node): row for row in info.sources}
    assert rows["/chatter", "/bot"].type == "std_msgs/String"
    assert "definitions differ" in rows["/mine", "/older"].problem
    ways = await answer(WHY, {"name": "/chatter", "site": "ros2"})
    assert [(way.peer, way.node) for way in ways] == [("ros2", "/bot")]
    with pytest.raises(UnreachableError):
        await answer(PARAM, {"site": "hall"})


async def test_questions_about_sites_go_to_what_answers_for_them(bed: Ros2Bed) -> None:
    bed.neighbour.sites = OtherSites()
    report: SitesReport = await bed.neighbour.answer(REPORT, {})
    assert [site.name for site in report.sites] == ["hall", "ros2"]
    for what, args in ((PARAM, {"site": "hall"}), (WHY, {"name": "/nothing"})):
        assert await bed.neighbour.answer(what, args) == ["of a site"]
