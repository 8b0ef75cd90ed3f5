"""What another site's gateway, or any program at the router, can announce: bounds hold for memory and for work."""

from __future__ import annotations

import contextlib
import itertools
import time
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import RemoteProtocolError
from rmpa.core.identity import is_global_name
from rmpa.gateway import limits
from rmpa.gateway.rules import CrossingRules, SourceKind
from rmpa.gateway.sites.answers import parse_ways
from rmpa.gateway.sites.catalogue import SiteCatalogue, SiteHistory
from rmpa.gateway.sites.keys import (
    AttachmentReader,
    MessageSource,
    SiteGateway,
    SiteModule,
    SiteSource,
    TopicHeader,
    parse_token,
)
from rmpa.gateway.sites.params import ParamAnswer, ParamQuestion, from_json, read_text_about, to_json
from rmpa.gateway.sites.plans import SiteImports

if TYPE_CHECKING:
    from collections.abc import Callable

RUN = "0123456789abcdef" * 2
MANY = 5000


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


CHUNKS = f"rmpa 1 eve arm up {RUN} t s a%B %n %x -gateway 0 * ** .. @x $* %% %..%etc \0 \x1b[2J é - %rmpa%hall".split(
    " "
)
ODD = st.one_of(st.text(max_size=60), st.lists(st.sampled_from([*CHUNKS, "", "9" * 5000]), max_size=12).map("/".join))


@given(ODD)
def test_a_token_is_refused_or_has_names_that_ros_allows(key: str) -> None:
    """No name of another site gets into a graph, a file or a terminal that is not one of ROS."""
    try:
        item = parse_token(key)
    except RemoteProtocolError:
        return
    if isinstance(item, SiteSource):
        assert is_global_name(item.name)
        assert is_global_name(item.node)
        assert item.module.site.isidentifier()
        assert item.module.name.isidentifier()
    elif isinstance(item, SiteGateway):
        assert 0 <= item.rank <= 999


BOMBS = [
    b"[" * 100_000,
    b'{"a":' * 100_000,
    b"[" * 400 + b"1" + b"]" * 400,
    b'{"a":' * 900 + b"1" + b"}" * 900,
    b"9" * 100_000,
    b'"\\ud800"',
    b"\xff\xfe",
    b"1e999",
    b"null",
    b"",
]


@pytest.mark.parametrize("bomb", BOMBS, ids=lambda bomb: repr(bomb[:8]))
@pytest.mark.parametrize(
    "parse",
    [
        ParamQuestion.parse,
        lambda data: read_text_about(data, ParamAnswer),
        TopicHeader.parse,
        parse_ways,
        lambda d: to_json(from_json(d)),
    ],
)
def test_json_bombs_are_refused_as_malformed(parse: Callable[[bytes], object], bomb: bytes) -> None:
    """Deep, giant and broken texts are an error that is told, never another exception."""
    with contextlib.suppress(RemoteProtocolError):
        parse(bomb)
