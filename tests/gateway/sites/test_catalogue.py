"""What other sites have: tokens in any order, short breaks, bounds; and which gateway of a site leads."""

from __future__ import annotations

import random
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.gateway import limits
from rmpa.gateway.rules import SourceKind
from rmpa.gateway.sites.catalogue import Leader, SiteCatalogue
from rmpa.gateway.sites.keys import SiteGateway, SiteModule, SiteSource

FOUND, RENEWED, GONE = "found", "renewed", "gone"
FIRST = SiteGateway("cloud", 1, "1" * 32)
SECOND = SiteGateway("cloud", 2, "2" * 32)
ARM = SiteModule("cloud", "arm", "a" * 32)
BASE = SiteModule("cloud", "base", "b" * 32)
SCAN = SiteSource(ARM, SourceKind.TOPIC, "sensor_msgs/LaserScan", "/lidar", "/scan")
STOP = SiteSource(BASE, SourceKind.SERVICE, "std_srvs/Trigger", "/driver", "/stop")
EVERYTHING = (FIRST, SECOND, ARM, BASE, SCAN, STOP)


class Followed(SiteCatalogue):
    """A catalogue of the site ``home``, and what it has told."""

    def __init__(self, own: str = "home") -> None:
        self.told: list[tuple[str, SiteSource]] = []
        tell = {word: partial(self._told, word) for word in (FOUND, RENEWED, GONE)}
        super().__init__(own, cast("Any", SimpleNamespace(**tell)), lambda *_: None)

    def _told(self, word: str, source: SiteSource) -> None:
        self.told.append((word, source))

    def all_tokens(self, now: float, *, alive: bool) -> None:
        for item in EVERYTHING:
            self.token(item.token(), now, alive=alive)


def told(catalogue: Followed) -> list[tuple[str, SiteSource]]:
    events, catalogue.told[:] = list(catalogue.told), []
    return events


def every_source(catalogue: SiteCatalogue) -> list[SiteSource]:
    """All that is there."""
    modules = [module for site in catalogue.sites for module in catalogue.modules(site)]
    return [source for module in modules for source in catalogue.sources(module)]


def with_everything() -> Followed:
    catalogue = Followed()
    catalogue.all_tokens(0.0, alive=True)
    told(catalogue)
    return catalogue


@pytest.mark.parametrize(("gone", "left"), [(ARM, [BASE]), (SCAN, [ARM, BASE])])
def test_a_module_that_is_killed_is_gone_within_a_fifth_of_a_second_with_its_sources_and_a_source_alone(
    gone: SiteModule | SiteSource, left: list[SiteModule]
) -> None:
    catalogue = with_everything()
    catalogue.token(gone.token(), 10.0, alive=False)
    due = catalogue.next_timer()
    assert due is not None
    assert due <= 10.2
    catalogue.handle_timer(due)
    assert told(catalogue) == [(GONE, SCAN)]
    assert catalogue.modules("cloud") == left


def test_tokens_of_this_site_are_not_another_sites_and_those_that_are_none_are_counted() -> None:
    catalogue = Followed("cloud")
    catalogue.all_tokens(0.0, alive=True)
    assert (catalogue.sites, catalogue.counters.as_dict()) == ((), {})
    for key in ("", "rmpa/1/cloud", ARM.token() + "x", f"rmpa/2{ARM.token()[6:]}", SCAN.token() + "/later"):
        catalogue.token(key, 0.0, alive=True)
    assert (catalogue.sites, catalogue.counters["site.token.malformed"]) == ((), 4)
    assert catalogue.counters["site.token.later_version"] == 1


def test_sites_modules_and_sources_have_bounds_that_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SITES_MAX", 2)
    monkeypatch.setattr(limits, "SITE_MODULES_MAX", 2)
    monkeypatch.setattr(limits, "SITE_SOURCES_MAX", 3)
    catalogue = Followed()
    modules = [SiteModule("cloud", f"m{number}", "0" * 32) for number in range(4)]
    for module in modules:
        catalogue.token(module.token(), 0.0, alive=True)
    for number in range(5):
        for module in (modules[0], modules[3]):  # the last one was refused
            source = SiteSource(module, SourceKind.TOPIC, "std_msgs/String", "/n", f"/t{number}")
            catalogue.token(source.token(), 0.0, alive=True)
    for number in range(4):
        catalogue.token(SiteModule(f"site{number}", "arm", "0" * 32).token(), 0.0, alive=True)
    assert len(catalogue.modules("cloud")) == 2
    assert len(catalogue.sources(modules[0])) == 2
    assert catalogue.refused("cloud") == 2 + 7
    assert catalogue.sites == ("cloud", "site0")
    assert catalogue.counters["site.limit"] == 2 + 7 + 3


ITEMS = st.sampled_from(
    [FIRST, SECOND, ARM, BASE, SCAN, STOP, SiteSource(ARM, SourceKind.TOPIC, "std_msgs/String", "/x", "/y")]
)


@given(st.lists(st.tuples(ITEMS, st.booleans(), st.floats(0, 1))))
def test_events_say_what_the_tokens_say_in_any_order(changes: list[tuple[SiteSource, bool, float]]) -> None:
    catalogue = Followed()
    alive: set[object] = set()
    shown: set[object] = set()
    now = 0.0

    def follow(change: str, item: SiteSource) -> None:
        if change == FOUND:
            assert item not in shown
            shown.add(item)
        elif change == RENEWED:
            assert item in shown
        else:
            shown.remove(item)

    for item, there, pause in changes:
        now += pause
        due = catalogue.next_timer()
        if due is not None and due <= now:
            catalogue.handle_timer(now)
        catalogue.token(item.token(), now, alive=there)
        (alive.add if there else alive.discard)(item)
        for event in told(catalogue):
            follow(*event)
    catalogue.handle_timer(now + 10)
    for event in told(catalogue):
        follow(*event)
    wanted = {item for item in alive if isinstance(item, SiteSource) and item.module in alive}
    assert shown == wanted == set(every_source(catalogue))
    assert catalogue.next_timer() is None


# --- Which gateway leads --------------------------------------------------------------------------------------------

PATIENCE = 1.0


def gateway(rank: int, number: int | None = None, site: str = "home") -> SiteGateway:
    return SiteGateway(site, rank, f"{rank if number is None else number:032x}")


def leads(leader: Leader) -> bool:
    """Asked by a function, since a type checker takes the attribute for unchanged."""
    return leader.leads


def test_the_lowest_rank_leads_and_of_equal_ones_the_lowest_instance() -> None:
    for own, other in ((gateway(2), gateway(1)), (gateway(1, 5), gateway(1, 4))):
        leader = Leader(own, PATIENCE, 0.0)
        leader.handle_timer(1.0)
        leader.seen(other, 2.0)
        assert not leads(leader)
        assert leader.leader == other
        assert leader.next_timer() is None


def test_of_gateways_that_hear_each_other_at_most_one_leads() -> None:
    for seed in range(200):
        rng = random.Random(seed)
        owns = [gateway(rng.randint(0, 3), number) for number in range(4)]
        leaders = {own: Leader(own, PATIENCE, 0.0) for own in owns}
        up: set[SiteGateway] = set(owns)
        for a in owns:
            for b in owns:
                leaders[a].seen(b, 0.0)
        now = 0.0
        for _ in range(60):
            now += rng.random()
            changed = rng.choice(owns)
            for other in owns:
                if changed in up:
                    leaders[other].gone(changed, now)
                else:
                    leaders[other].seen(changed, now)
            up ^= {changed}
            for leader in leaders.values():
                leader.handle_timer(now)
            # A token that is down belongs to a gateway that does not run: it is not asked.
            assert sum(leaders[own].leads for own in up) <= 1, (seed, now)
        now += PATIENCE
        for leader in leaders.values():
            leader.handle_timer(now)
        assert sum(leaders[own].leads for own in up) == (1 if up else 0)
