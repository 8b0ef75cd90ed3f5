"""``rmpa why`` and ``rmpa site`` between two gateways at one router: which site, hop and rule, and what is lost."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from rmpa.bridge.policy import PermissionGate
from rmpa.config.peer_rules import PermissionRule
from rmpa.config.rules import Crossing, CrossingRule
from rmpa.config.settings import TrustSettings
from rmpa.core.errors import RemoteProtocolError, RmpaError
from rmpa.gateway import limits
from rmpa.gateway.rules import ForeignSource, SourceKind
from rmpa.gateway.sites.answers import SiteAnswers, WhyQuestion, here_stages, parse_ways, sent_stages
from rmpa.gateway.sites.keys import SiteModule, SiteSource
from rmpa.gateway.sites.plans import SiteImport
from rmpa.observe.check import FAIL, OK, WARN, Check
from rmpa.observe.sites import REPORT, SITE_INFO, SITE_WHY, SitesReport
from rmpa.observe.why.diagnosis import Diagnosis
from rmpa.ros.wire.tcpros import TopicDescription
from rmpa.trust.permissions import Permissions
from tests.gateway.memory_zenoh import eventually as until
from tests.gateway.sites.site_bed import Site, SiteBed, site_bed

TEXT = TopicDescription("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1", "string data\n")
SCAN = SiteImport(
    ForeignSource(SourceKind.TOPIC, "yard", "arm", "/n", "/t", "a/B"),
    SiteSource(SiteModule("yard", "arm", "0" * 32), SourceKind.TOPIC, "a/B", "/n", "/t"),
)


@dataclass
class Asked:
    """One site, and what answers for it."""

    site: Site
    answers: SiteAnswers

    async def why(self, name: str, site: str = "", module: str = "", asker: str = "") -> list[Diagnosis]:
        args = {"name": name, "site": site, "module": module}
        found: list[Diagnosis] = await self.answers.answer(SITE_WHY, args, asker)
        return found

    async def report(self, what: str = REPORT, asker: str = "", **args: str) -> SitesReport:
        found: SitesReport = await self.answers.answer(what, args, asker)
        return found


class AskedBed:
    """Sites that are asked."""

    def __init__(self, bed: SiteBed) -> None:
        self._bed = bed

    async def site(
        self, name: str, rules: tuple[CrossingRule, ...] = (), permissions: tuple[PermissionRule, ...] | None = None
    ) -> Asked:
        gate = PermissionGate(None if permissions is None else Permissions(TrustSettings(rules=permissions)))
        site = await self._bed.site(name, rules=rules, gate=gate)
        asked = Asked(site, SiteAnswers(site.neighbour))
        await until(lambda: site.neighbour.leads)
        return asked

    async def pair(self, name: str = "/chatter") -> tuple[Asked, Asked]:
        """The sites ``yard``, which has a topic, and ``hall``, which shows it."""
        yard, hall = await self.site("yard"), await self.site("hall")
        yard.site.graph.add(name, TEXT)
        await until(lambda: hall.site.shows(name))
        return yard, hall


@pytest.fixture
async def bed() -> AsyncIterator[AskedBed]:
    async with site_bed() as made:
        yield AskedBed(made)


def levels(diagnosis: Diagnosis) -> dict[str, str]:
    return {stage.name: stage.level.value for stage in diagnosis.stages}


def failed(way: Diagnosis) -> Check:
    assert way.failed is not None
    return way.failed


async def test_rules_of_both_sites_are_named(bed: AskedBed) -> None:
    out = CrossingRule(names=("/home/**",), crossing=Crossing.NONE)
    into = CrossingRule(names=("/noise",), crossing=Crossing.OUT)
    yard, hall = await bed.site("yard", (out,)), await bed.site("hall", (into,))
    for name in ("/home/diary", "/noise", "/told"):
        yard.site.graph.add(name, TEXT)
    await until(lambda: hall.site.shows("/told"))
    (kept,) = await hall.why("/home/diary", "yard")
    assert (failed(kept).name, "gateway.rule 1 (none: /home/**)" in failed(kept).text) == ("rule there", True)
    (noise,) = await hall.why("/noise")
    assert (failed(noise).name, "gateway.rule 1 (out: /noise)" in failed(noise).text) == ("rule here", True)
    (own,) = await yard.why("/home/diary", asker="arm")
    assert failed(own).name == "rule here"
    (none,) = await hall.why("/none", "yard", "arm")
    assert failed(none).text == "no node of arm at yard has /none, as the gateway there sees it"
    info = await hall.report(SITE_INFO, site="yard")
    (site,) = info.sites
    problems = {source.name: source.problem for source in site.sources}
    assert problems["/told"] == ""
    assert "lets it not come in" in problems["/noise"]
    assert site.not_shown == 1


async def test_a_module_and_a_site_are_told_only_of_what_they_may_have(bed: AskedBed) -> None:
    """The answers about what is denied are equal to those about what is not there."""
    to_desk = PermissionRule(("desk",), names={"subscribe": ("/open",), "call": ("/open",)})
    to_hall = PermissionRule(("hall",), names={"subscribe": ("/open", "/hidden")})
    yard = await bed.site("yard", permissions=(to_hall,))
    to_yard = PermissionRule(("yard",), names={"publish": ("/**",), "subscribe": ("/home/**",)})
    hall = await bed.site("hall", permissions=(to_desk, to_yard))
    for name in ("/open", "/hidden", "/secret"):
        yard.site.graph.add(name, TEXT)
        hall.site.graph.add(f"/home{name}", TEXT, module="press")
    hall.site.graph.add("/home/mine", TEXT, module="desk")
    await until(lambda: hall.site.shows("/hidden") and hall.site.shows("/open"))
    for site, names in (("yard", {"/open"}), ("hall", {"/home/mine"})):
        (told,) = (await hall.report(SITE_INFO, "desk", site=site)).sites
        assert {source.name for source in told.sources} == names
        assert sum(module.topics for module in told.modules) == 1
        assert len((await hall.report(SITE_INFO, site=site)).sites[0].sources) > 1, "this machine's user"
    for name, real in (("/hidden", True), ("/none", False)):
        assert await hall.why(name, asker="desk") == []
        (denied,) = await hall.why(name, "yard", asker="desk")
        assert str(denied.failed).replace(name, "NAME").count("do not let desk subscribe to NAME") == 1, real
    (way,) = await hall.why("/open", asker="desk")
    assert way.node == "/talker"
    said = []
    for name in ("/secret", "/none"):
        (refused,) = await hall.why(name, "yard", "arm")
        said.append(str(refused.failed).replace(name, "NAME"))
    assert said[0] == said[1]
    assert "the permissions there do not let hall subscribe to NAME" in said[0]


async def test_a_site_that_left_is_unreachable_since_then_and_one_that_never_was_is_no_site(bed: AskedBed) -> None:
    yard, hall = await bed.pair()
    report = await hall.report()
    assert [(site.name, site.state) for site in report.sites] == [("hall", "this site"), ("yard", "joined")]
    assert report.leads
    (module,) = report.sites[1].modules
    assert (module.name, module.topics, module.services, module.shown) == ("arm", 1, 0, 1)
    await yard.site.neighbour.close()
    await until(lambda: hall.site.neighbour.catalogue.away == ("yard",))
    report = await hall.report()
    assert report.sites[1].state == "unreachable"
    assert report.sites[1].since_ago is not None
    (way,) = await hall.why("/chatter", "yard")
    assert failed(way).text.startswith("site yard is unreachable since")
    (unnamed,) = await hall.why("/chatter")  # the question of a user who does not know whose it was
    assert failed(unnamed).text.startswith("site yard is unreachable since")
    assert await hall.why("/other") == []
    assert await hall.why("/chatter", "joystick") == []  # a peer's name
    (moon,) = await hall.why("/chatter", "moon", "arm")
    assert "no gateway of a site moon" in failed(moon).text
    with pytest.raises(RmpaError, match=r"'site\.shout' is no question"):
        await hall.answers.answer("site.shout", {"site": "hall", "module": "arm"})


def test_losses_are_told_with_the_hop_where_they_happen() -> None:
    out: Any = SimpleNamespace(wanted=True, messages=90, waiting=2, dropped=7, limited=3)
    sent = sent_stages("yard", out, asked=True)[-1]
    assert sent.level is WARN
    assert "7 were dropped by its queue" in sent.text
    assert "3 were left out by rate or size of the rule" in sent.text
    into: Any = SimpleNamespace(
        wanted=True, messages=80, rate=lambda: 9.5, lost=10, dropped=0, mismatched=2, problem=""
    )
    arrived = here_stages(SCAN, into)[-1]
    assert (arrived.name, arrived.level) == ("arrived", WARN)
    assert arrived.text == (
        "80 messages have come, 9.5 Hz; 10 were lost between the gateways; 2 have another md5 sum than their header"
    )
    other: Any = SimpleNamespace(problem="its messages have the md5 sum aa, its header bb")
    assert [(stage.name, stage.level) for stage in here_stages(SCAN, other)[-1:]] == [("md5", FAIL)]


async def test_a_gateway_that_does_not_tell_leaves_its_half_open(bed: AskedBed) -> None:
    _, hall = await bed.pair()
    hall.site.session.network.queryables.clear()
    (way,) = await hall.why("/chatter")
    assert (levels(way)["source there"], levels(way)["demand here"]) == ("unknown", "fail")


async def test_a_router_that_keeps_a_subscription_back_is_named(
    bed: AskedBed, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = Check("demand there", WARN, "no other site subscribes")
    way = Diagnosis.of((said,), name="/chatter", peer="arm", to="site hall", node="/talker")

    async def ask(*_args: object, **_kwargs: object) -> object:
        return (way,), ""

    _, hall = await bed.pair()
    monkeypatch.setattr(SiteAnswers, "_ask", ask)
    (told,) = await hall.why("/chatter")
    assert levels(told)["demand there"] == "warn"
    await hall.site.subscribed("/chatter")
    (told,) = await hall.why("/chatter")
    assert failed(told).name == "router"


async def test_a_topic_for_some_sites_is_told_of_to_each_as_the_rules_are_for_it(bed: AskedBed) -> None:
    rules = (CrossingRule(sites=("hall",), crossing=Crossing.NONE),)
    yard = await bed.site("yard", rules)
    hall, cellar, attic = await bed.site("hall"), await bed.site("cellar"), await bed.site("attic")
    yard.site.graph.add("/chatter", TEXT)
    await cellar.site.subscribed("/chatter")
    await until(lambda: attic.site.shows("/chatter"))
    await until(lambda: yard.site.exported("/chatter", "cellar").wanted)
    (way,) = await cellar.why("/chatter")
    assert levels(way)["demand there"] == "ok"
    (way,) = await attic.why("/chatter")
    assert levels(way)["demand there"] == "warn", "the subscriber is at another site"
    (way,) = await hall.why("/chatter", "yard", "arm")
    assert levels(way)["rule there"] == "fail"
    assert "gateway.rule 1" in way.stages[-1].text
    assert {way.to for way in await yard.why("/chatter", asker="arm")} == {"site attic", "site cellar"}
    report = await yard.report(SITE_INFO, site="yard")
    assert [(module.name, module.topics) for module in report.sites[0].modules] == [("arm", 1)]


def test_a_question_that_is_none_is_refused() -> None:
    questions = (b"", b"{}", b'{"site": "a", "name": "x y"}', b"[" * 5000)
    answers = (b"{", b" " * limits.SITE_WHY_MAX + b"[]")
    for parse, texts in ((WhyQuestion.parse, questions), (parse_ways, answers)):
        for data in texts:
            with pytest.raises(RemoteProtocolError):
                parse(data)


def test_the_words_of_another_site_are_bounded_and_safe_to_show() -> None:
    stage = Check("sent\x1b[2J", OK, "a" * 1000, "\nroot@pc:~# ")
    way = Diagnosis.of((stage,), name="/t", peer="arm", to="site hall")
    ((told,),) = (each.stages for each in parse_ways(msgspec.json.encode([way])))
    assert (told.name, told.remedy, len(told.text) < 300) == ("sent\ufffd[2J", "\ufffdroot@pc:~# ", True)
