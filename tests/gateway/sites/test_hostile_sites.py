"""What another site's gateway, or any program at the router, can announce: bounds hold for memory and for work."""

from __future__ import annotations

import itertools
import time

import pytest

from rmpa.gateway import limits
from rmpa.gateway.rules import CrossingRules, SourceKind
from rmpa.gateway.sites.catalogue import SiteCatalogue, SiteHistory
from rmpa.gateway.sites.keys import (
    AttachmentReader,
    MessageSource,
    SiteModule,
    SiteSource,
)
from rmpa.gateway.sites.plans import SiteImports

RUN = "0123456789abcdef" * 2
MANY = 2000


def source(
    number: int, name: str, type_name: str, kind: SourceKind = SourceKind.TOPIC, site: str = "eve"
) -> SiteSource:
    return SiteSource(SiteModule(site, "arm", RUN), kind, type_name, f"/node{number}", name)


def test_all_sites_together_announce_a_bounded_number_of_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SITES_SOURCES_MAX", 100)
    catalogue = SiteCatalogue("home", lambda *_: None)
    for site in ("a", "b", "c"):
        catalogue.token(SiteModule(site, "arm", RUN).token(), 0.0, alive=True)
        for number in range(60):
            catalogue.token(source(number, "/x", "a/B", site=site).token(), 0.0, alive=True)
    assert sum(isinstance(each, SiteSource) for each in catalogue.all()) == 100
    assert catalogue.counters["site.limit"] == 80
    assert [catalogue.refused(site) for site in "abc"] == [0, 20, 60]
    for number in range(60):  # what goes makes room
        catalogue.token(source(number, "/x", "a/B", site="a").token(), 1.0, alive=False)
    catalogue.handle_timer(10.0)
    catalogue.token(source(0, "/y", "a/B", site="c").token(), 10.0, alive=True)
    assert sum(isinstance(each, SiteSource) for each in catalogue.all()) == 41


def test_thousands_of_publishers_of_one_name_are_judged_in_linear_time() -> None:
    imports = SiteImports(CrossingRules(), lambda *_: None)
    begin = time.process_time()
    for number in range(MANY):
        imports.found(source(number, "/x", "a/B"))
    few = time.process_time() - begin
    for number in range(MANY, 3 * MANY):
        imports.found(source(number, "/x", "a/B"))
    assert len(imports.entries) == 3 * MANY
    assert time.process_time() - begin - few < 20 * few, "twice as many, behind as many again"


@pytest.mark.parametrize("kind", list(SourceKind))
def test_a_crowd_that_waits_for_one_name_is_not_judged_anew_each_time(kind: SourceKind) -> None:
    """One program that shows and hides a source must not keep the gateway busy with all others of its name."""
    imports = SiteImports(CrossingRules(), lambda *_: None)
    holder = source(0, "/x", "a/First", kind)
    imports.found(holder)
    for number in range(1, MANY):
        imports.found(source(number, "/x", f"a/T{number}", kind))
    assert [entry.source.node for entry in imports.entries] == ["/node0"]
    assert sum(1 for _ in imports.refusals()) == MANY - 1, "each one is told, with its reason"
    judged = 0
    plan = imports._plan

    def counted(*args: object) -> object:
        nonlocal judged
        judged += 1
        return plan(*args)  # type: ignore[arg-type]

    imports._plan = counted  # type: ignore[method-assign, assignment]
    for _ in range(10):
        imports.gone(holder)
        assert len(imports.entries) == 1, "the next one has it"
        imports.found(holder)
    assert judged <= 10 * (limits.SITE_NAMES_WAITING_MAX + 2)


def test_what_sites_had_that_are_away_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SITES_SOURCES_MAX", 100)
    now = itertools.count(0.0)
    history = SiteHistory(lambda: next(now))
    for site in (f"s{number}" for number in range(20)):
        history.seen([site])
        for number in range(30):
            history.source(source(number, "/x", "a/B", site=site), there=True)
    history.seen([])
    assert len(history.away) == 20
    assert [site for site, _ in history.had("/x")] == ["s17", "s18", "s19"]


def test_attachments_of_invented_sources_fill_no_memory() -> None:
    reader = AttachmentReader()
    for number in range(5000):
        reader.read(MessageSource("0" * 32, f"/n{number}", ("eve",)).writer()(1, 1))
    assert len(reader._known) <= 256
