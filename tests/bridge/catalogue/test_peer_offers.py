"""How advertisements of one peer are split, and what is taken of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rmpa.bridge import limits
from rmpa.bridge.offers import Change, NodePlaces, PeerOffers

if TYPE_CHECKING:
    import pytest

Offers = PeerOffers[str, int, str]


def offers(*entries: str) -> Offers:
    made: Offers = PeerOffers(name="far", nodes=NodePlaces(10))
    made.entries.update(dict.fromkeys(entries, 1))
    return made


def changes(
    made: Offers, *added: str, removed: tuple[str, ...] = (), full: bool = False, more: bool = False
) -> list[Change[str, str]]:
    return list(made.changes(added, removed, str, full=full, more=more))


def test_long_advertisements_are_split_and_removals_go_first() -> None:
    many = tuple(f"/{number:03}" for number in range(limits.APPLIED_AT_ONCE + 1))
    assert changes(offers(), *many, removed=("/gone",)) == [
        Change(removed=("/gone",)),
        Change(added=many[:-1]),
        Change(added=many[-1:]),
    ]


def test_what_a_complete_account_does_not_mention_is_removed_at_its_end() -> None:
    made = offers("/a", "/b", "/c")
    assert changes(made, "/a", full=True, more=True) == [Change(added=("/a",))]
    assert changes(made, "/b", more=True) == [Change(added=("/b",))]
    assert changes(made, "/d") == [Change(removed=("/c",)), Change(added=("/d",))]
    assert changes(made) == []


def test_offers_beyond_the_limit_are_taken_when_there_is_room() -> None:
    made = offers("/a")
    made.refuse("/b", "/b")
    assert made.admitted(1) is None
    assert made.admitted(2) == "/b"
    assert made.admitted(2) is None


def test_a_complete_account_and_a_long_absence_forget_what_was_refused() -> None:
    made = offers()
    for end in (lambda: changes(made, full=True), made.give_up):
        made.refuse("/b", "/b")
        end()
        assert not made.refused


def test_a_bounded_number_of_refused_offers_is_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "REFUSED_MAX", 1)
    made = offers()
    for name in ("/a", "/b", "/a"):
        made.refuse(name, name.upper())
    assert dict(made.refused) == {"/a": "/A"}
