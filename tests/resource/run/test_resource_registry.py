from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rmpa.core.errors import RmpaError
from rmpa.resource import limits
from rmpa.resource.declare.resource import Resource
from rmpa.resource.run.descriptor import describe
from rmpa.resource.run.resource_registry import DESCRIPTOR, SEEN, ResourceRegistry

SECOND = 1_000_000_000
NOW = 1_800_000_000 * SECOND
PROXY = "/rmpa/base/sonar"


def text(name: str = "sonar", description: str = "") -> str:
    return describe(Resource(name, role="sensing", description=description), f"/{name}").serialize()


def kept(store: dict[tuple[str, str], str], rows: dict[tuple[str, str], str | None]) -> set[str]:
    """Do what a store does with rows; return the kinds that were written."""
    for key, value in rows.items():
        if value is None:
            store.pop(key, None)
        else:
            store[key] = value
    return {kind for kind, _ in rows}


def test_what_was_seen_outlives_a_restart() -> None:
    store: dict[tuple[str, str], str] = {}
    one = ResourceRegistry()
    assert kept(store, one.record("/sonar", PROXY, text(), NOW)) == {DESCRIPTOR, SEEN}
    assert kept(store, one.update({("/sonar", PROXY)}, NOW + 5 * SECOND)) == set()
    assert kept(store, one.flush()) == {SEEN}
    (found,) = ResourceRegistry(store).all
    assert (found.path, found.caller, found.descriptor.name) == ("/sonar", PROXY, "sonar")
    assert (found.first_ns, found.last_ns) == (NOW, NOW + 5 * SECOND)


def test_two_of_one_name_of_two_modules_are_two() -> None:
    one = ResourceRegistry()
    one.record("/sonar", "/sonar", text(description="ours"), NOW)
    one.record("/sonar", PROXY, text(description="theirs"), NOW + 1)
    assert [each.descriptor.description for each in one.all] == ["theirs", "ours"]


def test_times_are_written_seldom() -> None:
    store: dict[tuple[str, str], str] = {}
    one, here = ResourceRegistry(), {("/sonar", PROXY)}
    one.record("/sonar", PROXY, text(), NOW)
    late = NOW + int(limits.KNOWN_WRITE) * SECOND
    assert not one.update(here, late - SECOND)
    assert kept(store, one.update(here, late)) == {SEEN}
    assert not one.update(here, late + SECOND)
    assert kept(store, one.update(set(), late + 2 * SECOND)) == {SEEN}
    assert not one.update(set(), late + 900 * SECOND)
    assert one.all[0].last_ns == late + SECOND
    one.record("/sonar", PROXY, text(), late)
    assert kept(store, one.update(here, NOW - 10**9 * SECOND)) == {SEEN}


def test_another_descriptor_takes_the_place_of_the_last_one() -> None:
    one = ResourceRegistry()
    one.record("/sonar", PROXY, text(), NOW)
    assert not one.record("/sonar", PROXY, text(), NOW + 1)  # said again, as a module's own is: nothing to write
    assert (DESCRIPTOR, f"/sonar {PROXY}") in one.record("/sonar", PROXY, text(description="new"), NOW + 2)
    (found,) = one.all
    assert (found.descriptor.description, found.first_ns) == ("new", NOW)


def test_the_oldest_gives_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "KNOWN_MAX", 3)
    store: dict[tuple[str, str], str] = {}
    one = ResourceRegistry()
    for number in range(5):
        kept(store, one.record(f"/r{number}", f"/r{number}", text(f"r{number}"), NOW + number))
    assert [each.path for each in one.all] == ["/r4", "/r3", "/r2"]
    assert len(store) == 6
    monkeypatch.setattr(limits, "KNOWN_TEXT_MAX", len(text("r9")) + 10)
    kept(store, one.record("/r9", "/r9", text("r9"), NOW + 9))
    assert [each.path for each in ResourceRegistry(store).all] == ["/r9"]


def test_what_is_no_descriptor_is_refused_and_nothing_is_kept() -> None:
    one = ResourceRegistry()
    with pytest.raises(RmpaError):
        one.record("/strange", "/strange", "{}", NOW)
    assert not one.all


@given(
    st.dictionaries(st.tuples(st.sampled_from([DESCRIPTOR, SEEN]), st.sampled_from(["/a /a", "/a", ""])), st.text())
)
def test_any_file_can_be_read(rows: dict[tuple[str, str], str]) -> None:
    assert ResourceRegistry(rows).all == []
