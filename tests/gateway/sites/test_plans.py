"""What is offered to sites and shown of them, and hostile sites."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.bridge.policy import OPEN_GATE, PermissionGate
from rmpa.config.peer_rules import Effect, PermissionRule
from rmpa.config.rules import Crossing, CrossingRule
from rmpa.config.settings import TrustSettings
from rmpa.gateway import limits
from rmpa.gateway.rules import CrossingRules, ForeignSource, MeshSource, SourceKind
from rmpa.gateway.sites.catalogue import SiteCatalogue
from rmpa.gateway.sites.keys import (
    AttachmentReader,
    MessageSource,
    SiteModule,
    SiteSource,
    parse_token,
)
from rmpa.gateway.sites.plans import SiteExport, SiteExports, SiteImport, SiteImports
from rmpa.trust.permissions import Permissions
from tests.gateway.sites.test_catalogue import every_source

T, S = SourceKind.TOPIC, SourceKind.SERVICE
RUN = "0123456789abcdef" * 2


def mesh_source(
    name: str, module: str = "arm", type_name: str = "std_msgs/String", kind: SourceKind = T
) -> MeshSource:
    return MeshSource(kind, module, RUN, "/node", name, type_name, name, f"/rmpa/{module}/node")


def announced(name: str, module: str = "arm", type_name: str = "std_msgs/String", kind: SourceKind = T) -> SiteSource:
    return SiteSource(SiteModule("cloud", module, RUN), kind, type_name, "/node", name)


class Exports(SiteExports):
    """The exports of the site ``home``, and the changes that it has told."""

    def __init__(self, *rules: CrossingRule, site: str = "home", gate: PermissionGate = OPEN_GATE) -> None:
        self.told: list[tuple[SiteModule | SiteExport, bool]] = []
        told = CrossingRules(rules, gate=gate)
        super().__init__(site, told, lambda item, there: self.told.append((item, there)))

    def refusals(self) -> list[tuple[MeshSource, str]]:
        return [(source, why) for source, _, why in self.judged() if why]


class Imports(SiteImports):
    """Imports, and the changes that they have told."""

    def __init__(self, *rules: CrossingRule) -> None:
        self.told: list[tuple[SiteImport | None, SiteImport | None]] = []
        super().__init__(CrossingRules(rules), lambda old, new: self.told.append((old, new)))

    def refusals(self) -> list[tuple[SiteSource, str]]:
        return [(source, why) for source, _, why in self.judged() if why]


def test_what_stays_home_by_a_rule_or_a_name_that_no_key_can_hold_is_told() -> None:
    exports = Exports(CrossingRule(names=("/secret",), crossing=Crossing.IN))
    stay = {
        mesh_source("/secret"): "gateway.rule 1",
        replace(mesh_source("/one"), node="/" + "n" * 255): "more than 255 bytes",
        mesh_source("/" + "t" * limits.KEY_MAX): "characters",
        mesh_source("/odd", type_name="odd"): "its type is not known",
    }
    stop = mesh_source("/stop", type_name="*", kind=S)  # a service's type is not known before it was asked
    for source in (*stay, stop):
        exports.changed(source, there=True)
    [entry] = exports.entries
    assert (entry.source, parse_token(entry.announced.token())) == (stop, entry.announced)
    refused = dict(exports.refusals())
    assert all(why in refused.pop(source) for source, why in stay.items())
    assert not refused


def test_what_exceeds_the_bound_is_told_and_offered_when_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SITE_SOURCES_MAX", 1)
    exports = Exports()
    for name in ("/one", "/two"):
        exports.changed(mesh_source(name), there=True)
    [(source, why)] = exports.refusals()
    assert (source.name, "already" in why) == ("/two", True)
    exports.changed(mesh_source("/one"), there=False)
    assert [entry.source.name for entry in exports.entries] == ["/two"]
    assert exports.refusals() == []


def test_what_permissions_let_no_site_have_is_offered_to_none_and_the_rest_to_those_that_may() -> None:
    gate = PermissionGate(
        Permissions(
            TrustSettings(
                rules=(
                    PermissionRule(("yard",), names={"subscribe": ("/map", "/all"), "call": ("/dock",)}),
                    PermissionRule(("*",), names={"subscribe": ("/all", "/{peer}/**")}),
                    PermissionRule(("street",), effect=Effect.DENY, names={"subscribe": ("/all",)}),
                    PermissionRule(("*",), names={"subscribe": ("/open",)}),
                )
            )
        )
    )
    exports = Exports(gate=gate)
    exports.sites_seen(["yard", "street", "hall"])
    for name in ("/map", "/secret", "/all", "/open", "/hall/plan"):
        exports.changed(mesh_source(name), there=True)
    exports.changed(mesh_source("/dock", kind=S, type_name="*"), there=True)
    exports.changed(mesh_source("/off", kind=S, type_name="*"), there=True)
    assert {(each.source.name, each.announced.to) for each in exports.entries} == {
        ("/map", "yard"), ("/all", "yard"), ("/all", "hall"), ("/open", ""), ("/hall/plan", "hall"),
        ("/dock", "yard"),
    }  # fmt: skip
    assert {source.name: why for source, why in exports.refusals()} == {
        "/secret": "no [[permission]] lets yard subscribe to /secret",  # nor any other that is there
        "/off": "no [[permission]] lets any other site call /off",
    }


def test_sites_that_were_away_for_long_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SITES_REMEMBERED_MAX", 2)
    rules = (CrossingRule(sites=("yard*",)), CrossingRule(crossing=Crossing.NONE))
    exports = Exports(*rules)
    exports.changed(mesh_source("/scan"), there=True)
    for site in ("yard1", "yard2", "yard3"):
        exports.sites_seen([site])
    assert [each.announced.to for each in exports.entries] == ["yard3"]


def test_of_two_types_under_one_name_the_first_is_shown_and_the_other_told() -> None:
    imports = Imports()
    first, second = announced("/scan"), announced("/scan", "base", "std_msgs/Bool")
    imports.found(first)
    imports.found(second)
    assert [entry.announced for entry in imports.entries] == [first]
    [(source, why)] = imports.refusals()
    assert (source, "std_msgs/String" in why, "std_msgs/Bool" in why) == (second, True, True)
    imports.gone(first)
    assert [entry.announced for entry in imports.entries] == [second]
    assert imports.refusals() == []


def test_a_new_run_of_a_module_continues_its_sources() -> None:
    imports = Imports()
    old = announced("/scan")
    new = replace(old, module=replace(old.module, instance="f" * 32))
    imports.found(old)
    imports.found(new)
    imports.gone(old)
    [entry] = imports.entries
    assert imports.told[1:] == [(replace(entry, announced=old), replace(entry, announced=new))]
    imports.renewed(new)
    imports.gone(new)
    assert imports.told[2:] == [(entry, entry), (entry, None)], "its token was away for a moment, and then for good"


NAMES = st.sampled_from(["/a", "/b"])
MODULES = st.sampled_from(["arm", "base", "cam"])
TYPES = st.sampled_from(["std_msgs/String", "std_msgs/Bool"])


@given(st.lists(st.tuples(NAMES, MODULES, TYPES, st.sampled_from([T, S]), st.booleans(), st.booleans())))
def test_what_one_site_offers_is_shown_at_the_other_without_mixed_types(
    changes: list[tuple[str, str, str, SourceKind, bool, bool]],
) -> None:
    exports, imports = Exports(site="cloud"), Imports()
    shown: dict[ForeignSource, SiteSource] = {}
    there: set[str] = set()
    own: dict[tuple[SourceKind, str], set[str]] = {}
    for name, module, type_name, kind, come, at_home in changes:
        source = mesh_source(name, module, type_name, kind)
        if at_home:
            imports.own_changed(source, there=come)
            types = own.setdefault((kind, name), set())
            (types.add if come else types.discard)(f"{module} {type_name}")
        else:
            exports.changed(source, there=come)
        for item, offered in exports.told:
            if isinstance(item, SiteExport):
                token = item.announced.token()
                read = parse_token(token)
                assert isinstance(read, SiteSource)
                (there.add if offered else there.discard)(token)
                (imports.found if offered else imports.gone)(read)
        exports.told.clear()
        for before, after in imports.told:
            if before is not None:
                assert shown.pop(before.source) == before.announced
            if after is not None:
                assert after.source not in shown
                shown[after.source] = after.announced
        imports.told.clear()
    assert set(shown.values()) == {entry.announced for entry in imports.entries}
    refused = {source.token() for source, _ in imports.refusals()}
    assert {source.token() for source in shown.values()} | refused == there
    for foreign in shown:
        same = [each for each in shown if (each.kind, each.name) == (foreign.kind, foreign.name)]
        assert len({each.type for each in same}) == 1
        at_home_types = {text.split()[1] for text in own.get((foreign.kind, foreign.name), set())}
        assert at_home_types <= (set() if foreign.kind is S else {foreign.type})
        assert foreign.kind is T or len(same) == 1


MANY = 2000


def source(
    number: int, name: str, type_name: str, kind: SourceKind = SourceKind.TOPIC, site: str = "eve"
) -> SiteSource:
    return SiteSource(SiteModule(site, "arm", RUN), kind, type_name, f"/node{number}", name)


def test_all_sites_together_announce_a_bounded_number_of_sources(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SITES_SOURCES_MAX", 100)
    catalogue = SiteCatalogue("home", Imports(), lambda *_: None)
    for site in ("a", "b", "c"):
        catalogue.token(SiteModule(site, "arm", RUN).token(), 0.0, alive=True)
        for number in range(60):
            catalogue.token(source(number, "/x", "a/B", site=site).token(), 0.0, alive=True)
    assert len(every_source(catalogue)) == 100
    assert catalogue.counters["site.limit"] == 80
    assert [catalogue.refused(site) for site in "abc"] == [0, 20, 60]
    for number in range(60):  # what goes makes room
        catalogue.token(source(number, "/x", "a/B", site="a").token(), 1.0, alive=False)
    catalogue.handle_timer(10.0)
    catalogue.token(source(0, "/y", "a/B", site="c").token(), 10.0, alive=True)
    assert len(every_source(catalogue)) == 41


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
    imports = Imports()
    holder = source(0, "/x", "a/First", kind)
    imports.found(holder)
    for number in range(1, MANY):
        imports.found(source(number, "/x", f"a/T{number}", kind))
    assert [entry.source.node for entry in imports.entries] == ["/node0"]
    assert len(imports.refusals()) == MANY - 1, "each one is told, with its reason"
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
    catalogue = SiteCatalogue("home", Imports(), lambda *_: None)
    for when, site in enumerate(f"s{number}" for number in range(20)):
        tokens = [SiteModule(site, "arm", RUN).token()]
        tokens += [source(number, "/x", "a/B", site=site).token() for number in range(30)]
        for alive in (True, False):
            for token in tokens:
                catalogue.token(token, 10.0 * when, alive=alive)
        catalogue.handle_timer(10.0 * when + 1)
    assert len(catalogue.away) == 20
    assert [site for site, _ in catalogue.had("/x")] == ["s17", "s18", "s19"]
    assert catalogue.since_ago("s19", 200.0) == 9.0


def test_attachments_of_invented_sources_fill_no_memory() -> None:
    reader = AttachmentReader()
    for number in range(5000):
        reader.read(MessageSource("0" * 32, f"/n{number}", ("eve",)).writer()(1, 1))
    assert len(reader._known) <= 256
